"""The real renderer of objects, while the process may not write more than a kilobyte into a file."""

import resource
import signal
from contextlib import contextmanager

from data_gen.datasets import objects


@contextmanager
def open_renderer(settings):
    with objects.open_renderer(settings) as process:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024, hard))
        try:
            yield process
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, ignored)
