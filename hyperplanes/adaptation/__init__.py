"""Methods: support views -> a field."""

from hyperplanes.adaptation.base import AdaptedField, Adapter, Pictures, Renderable
from hyperplanes.adaptation.fine_tuning import FineTuned
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig, Prepared
from hyperplanes.adaptation.nearest_view import NearestView

__all__ = [
    "AdaptedField",
    "Adapter",
    "FineTuned",
    "HyperPlanes",
    "ModelConfig",
    "NearestView",
    "Pictures",
    "Prepared",
    "Renderable",
]
