"""The report of a run: one self-contained HTML page that opens offline.

It contains the verdict in words and tables, and the signals of the run in plots that can be zoomed. Its content
security policy forbids network access.
"""

from analogrig.reporting.page import render, write_report

__all__ = ["render", "write_report"]
