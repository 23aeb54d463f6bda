"""Values of interval MDPs with adversarial or cooperative nature."""
