"""Devices: kinds of estimator under test and how each is reached."""
