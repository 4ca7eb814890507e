"""Skip outside the guest: the tests would disturb a real bus."""

from __future__ import annotations

import os

from tests.soak.can_guest.__main__ import WITHIN

collect_ignore_glob = [] if os.environ.get(WITHIN) else ["test_*.py"]
