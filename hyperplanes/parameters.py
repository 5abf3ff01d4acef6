"""Named tensors that can be added: the weights theta of a target network and an update delta (HyperPlanes, Eq. 6)."""

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
        """The parameters of a module; the tensors are shared with it."""
        return cls(module.named_parameters())

    def __add__(self, update: Mapping[str, Tensor]) -> Parameters:
        """A copy in which the update is added to the tensors that it names; the other tensors are shared.

        Args:
            update: tensors by name, with the same shapes. It may omit names, but not add new ones.

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
