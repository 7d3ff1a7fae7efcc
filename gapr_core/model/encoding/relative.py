"""Relative positional embeddings r_ij in the keys, eq. (2) and (5), and as an option in the values."""

from __future__ import annotations

from torch import Tensor, nn

from gapr_core.model.attention import PairEncoding


class RelativeEncoding(PairEncoding):
    """r_ij = W_2 hidden_ij + b_2, of which only `hidden` is ever computed per pair.

    Everything after it is linear, so it is folded into the query, (f_q W^Q) (r_ij W^R)^T = (f_q W^Q W^R^T W_2)
    hidden_ij, and into the weighted sum of the values. The constant b_2 shifts all logits of a query alike and drops
    out of the softmax.
    """

    def __init__(self, hidden: Tensor, key_map: Tensor, value_map: nn.Module | None) -> None:
        self.hidden, self.key_map, self.value_map = hidden, key_map, value_map

    def bias(self, logits: Tensor, blocks: Tensor) -> Tensor:
        folded = blocks @ self.key_map  # (B, n, H, hidden)
        return logits + folded @ self.hidden.transpose(-1, -2)

    def values(self, blocks: Tensor, weights: Tensor) -> Tensor:
        return blocks if self.value_map is None else blocks + self.value_map(weights @ self.hidden)


class RelativeEncoder(nn.Module):
    """From embedded geometry (B, n, m, hidden) to its encoding: W_2 of the MLP, then W^R, optionally into values."""

    def __init__(self, hidden: int, dim: int, in_values: bool) -> None:
        super().__init__()
        self.second = nn.Linear(hidden, dim, bias=False)
        self.to_key = nn.Linear(dim, dim, bias=False)  # W^R
        self.to_value = nn.Linear(hidden, dim) if in_values else None

    def forward(self, hidden: Tensor) -> PairEncoding:
        return RelativeEncoding(hidden, self.to_key.weight @ self.second.weight, self.to_value)

    def folded(self, q: Tensor) -> Tensor:
        """(N, H, hidden), factors of the hidden layer in the logits, from queries (N, H, D)."""
        key_map = (self.to_key.weight @ self.second.weight).view(*q.shape[1:], -1)
        return (q.transpose(0, 1) @ key_map).transpose(0, 1)

    def valued(self, out: Tensor, mixed: Tensor) -> Tensor:
        """Sums of values (N, H, D) with the geometry's share, from sums of the hidden layer (N, H, hidden)."""
        if self.to_value is None:
            return out
        weight, bias = self.to_value.weight.view(*out.shape[1:], -1), self.to_value.bias.view(*out.shape[1:])
        return out + (mixed.transpose(0, 1) @ weight.transpose(1, 2)).transpose(0, 1) + bias
