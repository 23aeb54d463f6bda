"""What is acted in: MDPs, games, products, and the primitives through which they are seen."""
