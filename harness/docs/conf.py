"""Sphinx configuration of the documentation site: `make docs` builds it offline into build/docs."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from generated import write_reference  # the module beside this file

project = "analogrig"
author = "the analogrig authors"
release = metadata.version("analogrig")
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "deflist", "fieldlist"]
myst_heading_anchors = 3
smartquotes = False  # or --rig is typeset as an en dash
exclude_patterns = ["_build", "generated.py"]
html_theme = "furo"
html_title = f"analogrig {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_copy_source = False
pygments_style = "default"

write_reference(Path(__file__).parent / "reference")
