"""Environments of other packages as :class:`~jaxltl.core.models.environment.Environment`."""
