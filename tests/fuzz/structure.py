"""Structural fuzz, all of it: python tests/fuzz/structure.py

Exchanges each value of each structured file that jcr reads for one of another kind, and prints how reading it ended.
"""

import sys
import tempfile
from collections import Counter
from pathlib import Path

TESTS = Path(__file__).parents[1]


def main() -> None:
    """Try every value at every place, and print the histogram."""
    sys.path[:0] = [str(TESTS)]
    sys.path.remove(str(TESTS / "fuzz"))  # where this very file has the module's name
    from structure import TOO_LONG_S, VALUES, documents, places, tried

    show = sys.stdout.write
    with tempfile.TemporaryDirectory(prefix="jcr-structure-") as folder:
        total, slowest, bad = Counter[str](), (0.0, ""), []
        show(
            f"{'file':<28} {'places':>6} {'tries':>6} {'read':>6} {'status 2':>8} {'status 1':>8} {'slowest':>8}\n"
        )
        for name, document in documents(Path(folder)).items():
            ended, longest, count = Counter[str](), 0.0, 0
            for place in places(document.content):
                count += 1
                for value_name, value in VALUES.items():
                    how, seconds = tried(document, place, value)
                    kind = how if how in ("read", "status 2", "status 3") else "status 1"
                    ended[kind] += 1
                    longest = max(longest, seconds)
                    slowest = max(slowest, (seconds, f"{name} {place} {value_name}"))
                    if kind == "status 1" or seconds > TOO_LONG_S:
                        bad.append(f"{name} {place} = {value_name}: {how} ({seconds:.1f} s)")
            document.write(document.content)
            total += ended
            row = f"{ended['read']:>6} {ended['status 2']:>8} {ended['status 1']:>8} {longest:>6.2f} s"
            show(f"{name:<28} {count:>6} {sum(ended.values()):>6} {row}\n")
        show(f"all: {total.total()} tries, {dict(total)}; slowest {slowest[0]:.2f} s ({slowest[1]})\n")
        show("".join(f"BAD {line}\n" for line in bad))


main()
