"""Unbend's thin client."""
