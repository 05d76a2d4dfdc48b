"""What is deployed is checked with the programs that will read it: Prometheus, promtool, Helm, Docker Compose."""
