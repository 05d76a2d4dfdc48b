"""Pictures that explain an estimate."""
