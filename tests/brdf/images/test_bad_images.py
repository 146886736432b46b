"""Damaged pictures that others made: each is a picture or one line, in little memory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from project_paths import REAL, ROOT

BAD_IMAGES = REAL / "bad-images"


READ = """
import sys
import brdf
for path in sys.argv[1:]:
    try:
        print("image", brdf.read_picture(path).pixels.shape, flush=True)
    except brdf.InputError as error:
        print("error:", error, flush=True)
# The peak since the program started; getrusage would count the parent's memory at the fork.
print(int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) // 1024)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc to measure the peak of memory")
@pytest.mark.skipif(not BAD_IMAGES.is_dir(), reason=f"real data is missing: {BAD_IMAGES} (BRDF_REAL_DATA)")
def test_every_bad_image_is_a_picture_or_one_line():
    files = sorted(path for path in BAD_IMAGES.iterdir() if path.suffix in (".exr", ".png", ".jpg"))
    assert len(files) == 104
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", READ, *map(str, files)]
    done = subprocess.run(words, capture_output=True, env=environment, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stderr == b""
    *lines, megabytes = done.stdout.decode().splitlines()
    assert len(lines) == len(files)
    assert all(line.startswith(("image (", "error: ")) for line in lines)
    assert int(megabytes) < 500
