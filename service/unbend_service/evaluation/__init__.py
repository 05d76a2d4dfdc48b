"""Measuring models on pictures whose distortion is known. Needs what the service needs, and no more."""
