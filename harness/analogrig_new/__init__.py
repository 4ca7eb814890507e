"""Repositories that test an estimator of one's own, written by ``analogrig new``."""
