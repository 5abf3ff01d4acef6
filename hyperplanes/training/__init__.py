"""Meta-training: the hypernetwork and theta, or an initialisation alone, from tasks (HyperPlanes, Algorithm 1)."""

from hyperplanes.training.configuration import Progress, TrainingConfig
from hyperplanes.training.start import start_training
from hyperplanes.training.trainer import Trainer, train

__all__ = ["Progress", "Trainer", "TrainingConfig", "start_training", "train"]
