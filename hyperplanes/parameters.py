"""Named tensors that add: theta + delta, the weights of a target network and their update (HyperPlanes, Eq. 6)."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

__all__ = ["Parameters"]


class Parameters(dict[str, Tensor]):
    """The parameters of a network by name.

    >>> import torch
    >>> theta = Parameters(weight=torch.tensor([1.0]), bias=torch.tensor([2.0]))
    >>> (theta + Parameters(bias=torch.tensor([0.5])))["bias"].item()
    2.5
    """

    @classmethod
    def of(cls, module: nn.Module) -> Parameters:
        """The parameters of a module, shared with it."""
        return cls(module.named_parameters())

    def __add__(self, update: Mapping[str, Tensor]) -> Parameters:
        """A copy in which the named tensors are shifted and the others shared.

        Args:
            update: tensors of the same names and shapes; names may be missing, none may be new.

        Returns:
            New parameters; differentiable in both arguments.

        Raises:
            ValueError: an unknown name or another shape.
        """
        result = Parameters(self)
        for name, change in update.items():
            if name not in self:
                raise ValueError(f"update: expected names among {sorted(self)}, got {name!r}")
            if change.shape != self[name].shape:
                raise ValueError(f"update of {name}: expected {tuple(self[name].shape)}, got {tuple(change.shape)}")
            result[name] = self[name] + change
        return result

    def under(self, prefix: str) -> Parameters:
        """The parameters of one part, without its prefix: "colour.bias" for "fine.colour.bias" with prefix "fine"."""
        start = f"{prefix}."
        return Parameters((name[len(start) :], value) for name, value in self.items() if name.startswith(start))

    def detach(self) -> Parameters:
        """The same values, detached from the graph."""
        return Parameters((name, value.detach()) for name, value in self.items())
