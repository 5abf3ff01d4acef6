"""Meta-training of the hypernetwork and theta, or of an initialisation alone, on tasks (HyperPlanes, Algorithm 1)."""

from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.monitoring import Progress
from hyperplanes.training.start import start_training
from hyperplanes.training.trainer import Trainer, train

__all__ = ["Progress", "Trainer", "TrainingConfig", "start_training", "train"]
