"""These tests run in the guest alone: elsewhere they would disturb somebody's bus."""

from __future__ import annotations

import os

from tests.can_guest.__main__ import WITHIN

collect_ignore_glob = [] if os.environ.get(WITHIN) else ["test_*.py"]
