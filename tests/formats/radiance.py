"""Radiance as a reader of our files."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

ASK = """
import json, sys
from pyradiance import bsdf
loaded = bsdf.load_file(sys.argv[1])
print(json.dumps([bsdf.query(loaded, *at)[1] for at in json.load(sys.stdin)]))
"""


def ask_radiance(path: Path, directions: Any) -> Any:
    """What Radiance finds in a file, in a process of its own: its library may crash at a second file."""
    asked = json.dumps(np.asarray(directions, float).tolist())
    done = subprocess.run([sys.executable, "-c", ASK, path], input=asked, capture_output=True, text=True, check=True, timeout=90)
    return np.array(json.loads(done.stdout))
