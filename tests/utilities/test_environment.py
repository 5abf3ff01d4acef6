import subprocess
from importlib.metadata import version
from pathlib import Path

from hyperplanes.utilities.environment import find_commit

ROOT = Path(__file__).resolve().parents[2]


def test_the_commit_is_that_of_this_checkout():
    """Another implementation: git, asked in the folder of the project; outside of a checkout the package's version."""
    asked = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    commit = asked.stdout.strip() if (ROOT / ".git").exists() else f"version {version('hyperplanes')}"
    assert find_commit() == commit
