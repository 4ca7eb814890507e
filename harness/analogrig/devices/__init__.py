"""Devices under test: kinds, registry, sessions, and the estimator without a device."""
