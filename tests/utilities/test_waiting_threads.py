"""Source of truth: the environment of a fresh process after `import hyperplanes`, which is what OpenMP reads."""

import os
import subprocess
import sys

from hyperplanes.utilities.threads import DECIDED_BY

CODE = "import os, {first}; print(os.environ.get('OMP_WAIT_POLICY'), 'torch' in __import__('sys').modules)"


def policy(first, **variables):
    environment = {name: value for name, value in os.environ.items() if name not in DECIDED_BY} | variables
    code = CODE.format(first=first)
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return run.stdout.split()[0]


def test_threads_sleep_where_nobody_has_decided():
    assert policy("hyperplanes") == "PASSIVE"


def test_what_the_user_decided_stays():
    assert policy("hyperplanes", OMP_WAIT_POLICY="ACTIVE") == "ACTIVE"
    assert policy("hyperplanes", GOMP_SPINCOUNT="1000") == "None"


def test_nothing_is_set_once_torch_is_loaded():
    """A module of its name stands for PyTorch, which takes seconds to load."""
    assert policy("sys; sys.modules['torch'] = sys; import hyperplanes") == "None"
