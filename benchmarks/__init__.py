"""Measurements of Unbend against named peers, in the same run."""
