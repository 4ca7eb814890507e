"""The compiled engine: piecewise linear state spaces, played exactly."""
