"""The traced engine: iteration, certificates, linear systems, implicit derivatives."""
