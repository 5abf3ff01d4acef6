"""The real worker, in a process that may not write more than a kilobyte into a file."""

import resource
import signal

from data_gen.datasets import objects


def open_renderer(settings):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    opened = objects.open_renderer(settings)

    class Limited:
        def __enter__(self):
            process = opened.__enter__()
            resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))
            return process

        def __exit__(self, *details):
            return opened.__exit__(*details)

    return Limited()
