"""Source of truth: the environment of a new process after `import hyperplanes`, which OpenMP reads."""

import os
import subprocess
import sys

from hyperplanes.utilities.machine.threads import DECIDED_BY

CODE = "import os, {first}; print(os.environ.get('OMP_WAIT_POLICY'), 'torch' in __import__('sys').modules)"


def policy(first, **variables):
    environment = {name: value for name, value in os.environ.items() if name not in DECIDED_BY} | variables
    code = CODE.format(first=first)
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return run.stdout.split()[0]


def test_the_default_wait_policy_is_passive():
    assert policy("hyperplanes") == "PASSIVE"


def test_the_wait_policy_of_the_user_is_not_changed():
    assert policy("hyperplanes", OMP_WAIT_POLICY="ACTIVE") == "ACTIVE"
    assert policy("hyperplanes", GOMP_SPINCOUNT="1000") == "None"


def test_no_wait_policy_is_set_after_torch_is_loaded():
    """A fake module replaces PyTorch, which takes seconds to load."""
    assert policy("sys; sys.modules['torch'] = sys; import hyperplanes") == "None"
