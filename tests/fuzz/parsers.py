"""A coverage-guided fuzzer on one reader: python tests/fuzz/parsers.py poses.csv -max_total_time=600

Needs atheris (pip install atheris). The names are those of tests/fuzz_targets.py, and `line` is the protocol of
`jcr capture`; further arguments are libFuzzer's. Whatever is neither read nor refused with an InputError is
written to crash-… in the current folder: make a test of it.
"""

import sys
import tempfile
from pathlib import Path

import atheris

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent)]
READERS = [
    "jcr.capture",
    "jcr.calibration.record",
    "jcr.cli.query",
    "jcr.scene.cloud_ply",
    "jcr.live",
    "jcr.pointmaps",
    "jcr.reconstruction_npz",
]
READERS += ["jcr.scene", "rosbags", "safetensors", "yaml"]
with atheris.instrument_imports(include=READERS):
    from fuzz_targets import targets
    from jcr.errors import InputError
    from jcr.live.server import sample_pose


def main() -> None:
    """Fuzz the reader that the first argument names, from its valid file."""
    name = sys.argv.pop(1)
    folder = Path(tempfile.mkdtemp(prefix="jcr-fuzz-"))
    corpus = folder / "corpus"
    corpus.mkdir()
    if name == "sample":
        (corpus / "valid").write_bytes(b'{"base_from_gripper": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}\n')

        def feed(data: bytes) -> None:
            sample_pose(data)
    else:
        target = targets(folder / "targets")[name]
        (corpus / "valid").write_bytes(target.file.read_bytes())
        feed = target.feed

    def once(data: bytes) -> None:
        try:
            feed(data)
        except InputError:
            return

    atheris.Setup([*sys.argv, str(corpus), "-timeout=20", "-rss_limit_mb=4096"], once)
    atheris.Fuzz()


main()
