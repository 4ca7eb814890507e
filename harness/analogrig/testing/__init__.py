"""Property-based tests and the pytest plugin."""
