"""`benchmarks robots`: is the reported sigma true of arms that err systematically, and is the result nearer?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.figure import blank, png
from benchmarks.page import table
from benchmarks.peers import opencv
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.files import write_bytes
from jcr.records import HandEye
from simulation.arms import PresetName
from simulation.problems import BentProblem, bent_problem, error

ARMS = ROBOT_NAMES
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
COUNTS = (8, 12, 30)
DRAWS = 1
"""Of each arm."""

Solve = Callable[[BentProblem], HandEye]

WHITE = "white alone"
KNOWN: dict[str, Solve] = {
    "joints known": lambda p: solve_hand_eye(
        p.base_from_gripper, p.recon_from_camera, joints=p.joints, robot=p.bent.arm
    ),
    "robot given": lambda p: solve_hand_eye(p.base_from_gripper, p.recon_from_camera, robot=p.bent.arm),
    "nothing known": lambda p: solve_hand_eye(p.base_from_gripper, p.recon_from_camera),
    WHITE: lambda p: solve_hand_eye(
        p.base_from_gripper,
        p.recon_from_camera,
        systematic=np.zeros((6 * len(p.base_from_gripper), 6 * len(p.base_from_gripper))),
    ),
}
"""Three ways of knowing the robot, and independent errors alone with both sizes estimated, as HALCON publishes it."""
PEER = "OpenCV Park"


@dataclass(frozen=True)
class Row:
    """What came of all draws of one cell, against the effective hand-eye transform."""

    arms: tuple[str, ...]
    preset: PresetName
    count: int
    known: str
    mm: float
    """Median."""
    deg: float
    accepted: float
    """Share; what follows is of the accepted results, nan where there is none or no sigma."""
    beyond_3: float = np.nan
    """Share of results with more than three sigma on an axis of translation or rotation."""
    beyond_5: float = np.nan
    distance: float = np.nan
    """Squared Mahalanobis distance over its 6 degrees of freedom, mean."""
    std_mm: float = np.nan
    """Median of the reported sigma, root mean square over axes."""


def measure(
    arms: Sequence[str] = ARMS,
    presets: Sequence[PresetName] = PRESETS,
    counts: Sequence[int] = COUNTS,
    draws: int = DRAWS,
) -> list[Row]:
    """A row per size of errors, number of images and way of knowing the robot; draws of each arm."""
    rows = []
    for preset in presets:
        for count in counts:
            problems = [
                bent_problem(arm_named(arm), preset, count, seed) for arm in arms for seed in range(draws)
            ]
            cell = tuple(arms), preset, count
            rows += [_row(*cell, name, [(p, KNOWN[name](p)) for p in problems]) for name in KNOWN]
            rows.append(_peer(*cell, problems))
    return rows


def _row(
    arms: tuple[str, ...],
    preset: PresetName,
    count: int,
    known: str,
    answers: list[tuple[BentProblem, HandEye]],
) -> Row:
    off = np.array([error(problem, one.gripper_from_camera, one.scale)[:6] for problem, one in answers])
    covariance = np.array([one.covariance[:6, :6] for _, one in answers])
    accepted = np.array([one.converged for _, one in answers])
    mm, deg = _lengths(off)
    if not accepted.any():
        return Row(arms, preset, count, known, mm, deg, 0.0)
    off, covariance = off[accepted], covariance[accepted]
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    worst = np.abs(off / std).max(1)
    squared = np.einsum("ki,ki->k", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return Row(
        arms,
        preset,
        count,
        known,
        mm,
        deg,
        float(accepted.mean()),
        float((worst > 3).mean()),
        float((worst > 5).mean()),
        float(squared.mean() / 6),
        1e3 * float(np.median(np.sqrt((std[:, :3] ** 2).mean(1)))),
    )


def _peer(arms: tuple[str, ...], preset: PresetName, count: int, problems: list[BentProblem]) -> Row:
    off = []
    for problem in problems:
        x, scale = opencv("Park", problem.base_from_gripper, problem.recon_from_camera, problem.scale)
        off.append(error(problem, x, scale)[:6])
    return Row(arms, preset, count, PEER, *_lengths(np.array(off)), 1.0)


def _lengths(off: Float[ndarray, "k 6"]) -> tuple[float, float]:
    metres, radians = np.median(np.linalg.norm(off.reshape(-1, 2, 3), axis=2), axis=0)
    return 1e3 * float(metres), float(np.degrees(radians))


def run(out: Path | None = None) -> str:
    """Markdown: the claims, then tables; an image in `out` shows the shares beyond three sigma."""
    rows = measure()
    if out is not None:
        write_bytes(out / "robots.png", _figure(rows))
    return page(rows, DRAWS)


def _figure(rows: list[Row]) -> bytes:
    """A panel per number of images: share of accepted results beyond three sigma, by size of the errors."""
    counts = sorted({row.count for row in rows})
    figure = blank(11, 3.4, "constrained")
    for k, count in enumerate(counts):
        axes = figure.add_subplot(1, len(counts), k + 1)
        for j, known in enumerate(KNOWN):
            mine = [row for row in rows if row.count == count and row.known == known]
            places = np.arange(len(mine)) + (j - 1.5) / 5
            axes.bar(places, [100 * row.beyond_3 for row in mine], 0.18, label=known)
            axes.set_xticks(np.arange(len(mine)), [row.preset.split("-")[0] for row in mine], fontsize=8)
        axes.axhline(4, color="black", linewidth=0.6, linestyle=":")
        axes.set_title(f"{count} images", fontsize=9)
        axes.set_ylim(0, 100)
        if k == 0:
            axes.set_ylabel("% of accepted results beyond 3 σ")
            axes.legend(fontsize=8)
    return png(figure, 110)


def page(rows: list[Row], draws: int) -> str:
    """Markdown of measured rows; `draws` is how many of each arm."""
    fixed = [row for row in rows if row.known in KNOWN and row.known != WHITE and row.accepted > 0]
    white = [row for row in rows if row.known == WHITE and row.preset != "white" and row.accepted > 0]
    lines = [
        f"> Simulated arms with systematic errors, {', '.join(rows[0].arms)}: {_pooled(fixed):.1f} % of the accepted "
        f"results are beyond 3 of their own σ on an axis, {100 * max(row.beyond_3 for row in fixed):.0f} % in the worst "
        f"row, {100 * max(row.beyond_5 for row in fixed):.0f} % beyond 5 there; where errors count as independent "
        f"{_pooled(white):.0f} %, up to {100 * max((row.beyond_3 for row in white), default=np.nan):.0f} %.",
        "",
        f"{draws} draws of each arm (seeds 0 to {draws - 1}), against the effective hand-eye transform; cameras of "
        "0.05 mm and 0.005°. OpenCV's method is given the scale and has no σ. White alone: independent errors of both "
        "sizes estimated, as HALCON's published model has them.",
        "",
        "![share of results beyond three sigma](robots.png)",
        "",
        *table(
            "errors | images | known | median error | accepted | > 3 σ | > 5 σ | squared distance / 6 | σ per axis",
            map(_cells, rows),
        ),
    ]
    return "\n".join(lines) + "\n"


def _pooled(rows: Sequence[Row]) -> float:
    """Per cent of all accepted results beyond three sigma; all rows are of as many draws."""
    accepted = sum(row.accepted for row in rows)
    return 100 * sum(row.accepted * row.beyond_3 for row in rows) / accepted if accepted else np.nan


def _cells(row: Row) -> list[str]:
    cells = [row.preset, f"{row.count}", row.known, f"{row.mm:.2f} mm {row.deg:.3f}°"]
    if np.isnan(row.distance):
        return [*cells, "–" if row.known == PEER else f"{100 * row.accepted:.0f} %", *4 * ["–"]]
    shares = [f"{100 * share:.0f} %" for share in (row.accepted, row.beyond_3, row.beyond_5)]
    return [*cells, *shares, f"{row.distance:.2f}", f"{row.std_mm:.2f} mm"]
