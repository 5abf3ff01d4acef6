"""Meta-training: the hypernetwork and theta, or an initialisation alone, from tasks (HyperPlanes, Algorithm 1)."""

from hyperplanes.training.start import start_training
from hyperplanes.training.trainer import Progress, Trainer, TrainingConfig, train

__all__ = ["Progress", "Trainer", "TrainingConfig", "start_training", "train"]
