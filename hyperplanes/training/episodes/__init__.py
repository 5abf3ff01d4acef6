"""The objects of the steps of a training: how they are drawn, prepared and augmented."""

from hyperplanes.training.episodes.episode import Episode, prepare_episode
from hyperplanes.training.episodes.loader import Batch, Draw, EpisodeLoader

__all__ = ["Batch", "Draw", "Episode", "EpisodeLoader", "prepare_episode"]
