"""The report of a run: one self-contained HTML page that opens offline.

It holds the verdict in words and tables, and the signals of the run for plots that can be zoomed. The page asks the
network for nothing, and its content security policy would not let it.
"""

from analogrig.reporting.page import render, write_report

__all__ = ["render", "write_report"]
