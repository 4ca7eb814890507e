"""The report of a run: one self-contained HTML page that opens offline.

It contains the verdict in words and tables, and the signals of the run in plots that can be zoomed. Its content
security policy forbids network access.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.pages import PLOTS, assemble_page
    from analogrig.reporting.page import provenance, render, write_report
    from analogrig.reporting.payload import as_script, deflate
    from analogrig.reporting.run_summary import lamps_text
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.pages": "PLOTS assemble_page",
            "analogrig.reporting.payload": "as_script deflate",
            "analogrig.reporting.run_summary": "lamps_text",
            "analogrig.reporting.page": "provenance render write_report",
        },
    )

__all__ = [
    "PLOTS",
    "as_script",
    "assemble_page",
    "deflate",
    "lamps_text",
    "provenance",
    "render",
    "write_report",
]
