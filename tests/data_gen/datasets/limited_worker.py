"""The renderer of objects in a process that may not write more than one kilobyte to a file."""

import resource
import signal

from data_gen.datasets import objects


def open_renderer(settings):
    process = objects.open_renderer(settings)

    def limited(item):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024, hard))
        try:
            return process(item)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, ignored)

    return limited
