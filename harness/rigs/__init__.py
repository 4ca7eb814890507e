"""Rigs: what plays a scenario and yields samples."""
