"""Environments of other packages as :class:`~jaxltl.core.environments.environment.Environment`."""
