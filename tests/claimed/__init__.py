"""Firmwares with protocols of their own around the bundled estimator, each with fifteen planted defects."""
