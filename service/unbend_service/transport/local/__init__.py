"""Clients of the same host: the socket over which they share memory."""
