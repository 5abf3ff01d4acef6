"""Methods: support views -> a field."""

from hyperplanes.adaptation.base import AdaptedField, Adapter, Pictures, Renderable
from hyperplanes.adaptation.baselines.hull_blend import HullBlend
from hyperplanes.adaptation.baselines.nearest_view import NearestView
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.correction.residuals import CorrectedField, ResidualField
from hyperplanes.adaptation.diagnostics import Diagnostics, diagnose, swap_gap
from hyperplanes.adaptation.fine_tuned import FieldFromScratch, FineTuned, FromScratch
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.configuration.initialisation import InitialisationConfig

__all__ = [
    "AdaptedField",
    "Adapter",
    "CorrectedField",
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
    "Renderable",
    "ResidualField",
    "SupportContext",
    "Swapped",
    "diagnose",
    "swap_gap",
]
