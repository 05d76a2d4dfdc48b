"""The Unbend service: estimation, rendering, HTTP and gRPC."""
