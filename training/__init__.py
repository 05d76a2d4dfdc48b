"""Training of the estimators: torch lives here only, and the service never imports this package."""
