"""Whole numbers: what samples, ticks, bits and codes are counted in, whoever hands them in."""

from __future__ import annotations

from numbers import Integral

__all__ = ["is_whole"]


def is_whole(number: object) -> bool:
    """Whether it is an integer of Python's or numpy's; 5.0 is none."""
    return isinstance(number, Integral)
