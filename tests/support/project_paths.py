"""Where the project, its browser tests and the real photographs and measurements are."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BROWSER = ROOT / "tests" / "browser"
REAL = Path(os.environ.get("BRDF_REAL_DATA", ROOT.parent / "shared" / "data"))
real_data = pytest.mark.skipif(not REAL.is_dir(), reason=f"real data is missing: {REAL} (BRDF_REAL_DATA)")
