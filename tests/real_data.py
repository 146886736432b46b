"""Where the real photographs and measurements are."""

import os
from pathlib import Path

import pytest

REAL = Path(os.environ.get("BRDF_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
real_data = pytest.mark.skipif(not REAL.is_dir(), reason=f"real data is missing: {REAL} (BRDF_REAL_DATA)")
