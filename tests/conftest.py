"""What holds for all tests."""

from __future__ import annotations

import os

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")  # nothing is fetched, here or in processes that tests start
