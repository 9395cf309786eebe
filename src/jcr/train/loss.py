"""What training makes small: DUSt3R's confidence-weighted regression, and attention that looks elsewhere.

Shapes: e pairs of images of h x w pixels, n and m tokens of the first and second.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from jcr.reconstruct.dust3r.network import CrossAttention, Pointmap


def confident_regression(
    predicted: tuple[Pointmap, Pointmap],
    true: tuple[Float[Tensor, "e h w 3"], Float[Tensor, "e h w 3"]],
    alpha: float,
) -> tuple[Tensor, Tensor]:
    """C·l − alpha·log C over the pixels of both views, and the mean of the distances l alone.

    l is the distance of predicted and true points in the first camera's frame, each in the unit of its own
    pair, so that the pair's scale does not matter (Wang et al. 2024, eq. 2 to 4). The unit is the geometric mean
    of the points' distances, where the paper has the arithmetic one: a far wall must not squeeze the table.
    """
    unit, true_unit = _unit(predicted[0].points, predicted[1].points), _unit(*true)
    objectives, distances = [], []
    for view, points in zip(predicted, true, strict=True):
        distance = (view.points / unit - points / true_unit).square().sum(-1).clamp(min=1e-12).sqrt()
        objectives.append((view.confidence * distance - alpha * view.confidence.log()).mean())
        distances.append(distance.mean())
    return torch.stack(objectives).mean(), torch.stack(distances).mean()


def _unit(points1: Tensor, points2: Tensor) -> Float[Tensor, "e 1 1 1"]:
    """Geometric mean of the distances from the first camera."""
    squares = [(points.square().sum(-1).clamp(min=1e-12)).log().mean((1, 2)) for points in (points1, points2)]
    return (torch.stack(squares).mean(0) / 2).exp()[:, None, None, None]


def true_attention(
    seen: Bool[Tensor, "e rows columns"],
    pixel: Float[Tensor, "e rows columns 2"],
    size: tuple[int, int],
    patch: int,
) -> Float[Tensor, "e n m"]:
    """The share of each first token's samples that the second image shows in each of its tokens.

    `seen` and `pixel` are samples of the first image on a regular grid, whole numbers of them a token, as
    `scenes.seen_by` gives them; `size` (width, height) is that of both images, `patch` the side of a token,
    both in pixels.
    """
    columns, rows = size[0] // patch, size[1] // patch
    x, y = (pixel / patch + 0.5 / patch).floor().long().unbind(-1)
    token = (y.clamp(0, rows - 1) * columns + x.clamp(0, columns - 1)).where(seen, rows * columns)
    of_first = token.unflatten(2, (columns, -1)).unflatten(1, (rows, -1))  # e rows i columns j
    of_first = of_first.transpose(2, 3).reshape(len(seen), rows * columns, -1)
    share = torch.zeros(len(seen), rows * columns, rows * columns + 1, device=seen.device)
    share.scatter_add_(2, of_first, torch.full(of_first.shape, 1 / of_first.shape[-1], device=seen.device))
    return share[..., :-1]


def attention_miss(
    attention: CrossAttention,
    inputs: tuple[Tensor, Tensor, Tensor, Tensor],
    true: Float[Tensor, "e n m"],
) -> Tensor:
    """Cross-entropy of the first half of a cross-attention's heads with where the same points are, in nats.

    Not in the paper: a network this small, trained this little, is slow to find out on its own that
    correspondences are worth looking for.
    """
    logits = attention.matching_scores(*inputs)
    miss = -(true[:, None] * F.log_softmax(logits, -1)).sum((2, 3)).mean(1)
    return miss.sum() / true.sum().clamp(min=1)
