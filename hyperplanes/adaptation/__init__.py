"""Methods: support views -> a field."""

from hyperplanes.adaptation.base import AdaptedField, Adapter, Pictures, Renderable
from hyperplanes.adaptation.diagnostics import Diagnostics, diagnose, swap_gap
from hyperplanes.adaptation.fine_tuned import FieldFromScratch, FineTuned, FromScratch
from hyperplanes.adaptation.fine_tuning import FineTuning
from hyperplanes.adaptation.hull_blend import HullBlend
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.adaptation.initialisation import InitialisationConfig
from hyperplanes.adaptation.nearest_view import NearestView
from hyperplanes.adaptation.prepared import Prepared
from hyperplanes.adaptation.swapped import Swapped

__all__ = [
    "AdaptedField",
    "Adapter",
    "Diagnostics",
    "FieldFromScratch",
    "FineTuned",
    "FineTuning",
    "FromScratch",
    "HullBlend",
    "HyperPlanes",
    "InitialisationConfig",
    "ModelConfig",
    "NearestView",
    "Pictures",
    "Prepared",
    "Renderable",
    "Swapped",
    "diagnose",
    "swap_gap",
]
