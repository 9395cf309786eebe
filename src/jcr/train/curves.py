"""`python -m jcr.train.curves PNG FOLDER ...`: the curves of trainings, side by side."""

import json
import sys
from pathlib import Path

import numpy as np

from jcr.files import written_whole


def draw(png: Path, folders: list[Path]) -> None:
    """Loss, attention and validation over the pairs seen, from the log.jsonl of each training."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (losses, attention, rotation) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for number, folder in enumerate(folders):
        lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
        # A training that was stopped did the last steps before it again.
        rows = [row for _, row in sorted({row["step"]: row for row in lines}.items())]
        steps = np.array([row["step"] for row in rows])
        pairs = np.cumsum(np.diff(steps, prepend=0) * [row["pairs"] for row in rows]) / 1e3
        for axes, name in ((losses, "distance"), (attention, "attention")):
            axes.plot(pairs, _smooth(np.array([row[name] for row in rows])), f"C{number}", label=folder.name)
        looks = [(x, row["validation"]) for x, row in zip(pairs, rows, strict=True) if "validation" in row]
        for name, style in (("held-out scenes", "-"), ("captures", ":")):
            found = [
                [v["rotation_deg"] for k, v in look.items() if (k == "held-out scenes") == (style == "-")]
                for _, look in looks
            ]
            if all(found) and len(found) > 1:
                medians = [np.median(values) for values in found]
                rotation.plot(
                    [x for x, _ in looks], medians, f"C{number}.{style}", label=f"{folder.name}, {name}"
                )
    losses.set(title="distance from the truth, in units of the pair", yscale="log")
    attention.set(title="attention's cross-entropy, nats")
    rotation.set(title="median relative rotation error, degrees", ylim=(0, None))
    for axes in (losses, attention, rotation):
        axes.set_xlabel("thousand pairs seen")
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:  # a short training has no curve of validation
            axes.legend(fontsize=8, loc="upper right")
    with written_whole(png) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def _smooth(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Running mean that shrinks at the ends."""
    window = np.ones(min(width, len(values)))
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")


if __name__ == "__main__":
    draw(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
