"""Meters: what is counted, for those who watch."""
