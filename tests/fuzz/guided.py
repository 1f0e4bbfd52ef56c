"""Coverage-guided fuzzing of one parser by atheris. Usage: python -m fuzz.guided TARGET SEED SECONDS"""

import importlib
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from fuzz.seeds import mutable_files

atheris: Any = importlib.import_module("atheris")  # in the extra `fuzz`

with atheris.instrument_imports(include=["aero_viz.recordings", "aero_viz.scenes"]):
    from fuzz.targets import TARGETS

    from aero_viz.errors import UserError
    from aero_viz.scenes.map_decoders import decode


def main() -> None:
    """Explore a target from a seed; ends with a status other than 0 at the first failure."""
    target, seed, seconds = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
    file = mutable_files(seed)[1][-1]
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    corpus, case = folder / "corpus", folder / file.name
    corpus.mkdir()
    shutil.copy(file, corpus)

    def one_input(content: bytes) -> None:
        case.write_bytes(content)
        try:
            if target == "decoder":
                decode(case, "any")
            else:
                TARGETS[target](case)
        except UserError:
            pass
        except Exception:  # the process that decodes maps reports any exception in one sentence
            if target != "decoder":
                raise

    limits = [f"-max_total_time={seconds}", "-timeout=20", "-rss_limit_mb=2048", "-max_len=100000", "-verbosity=1"]
    atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={folder}/", str(corpus)], one_input)
    try:
        atheris.Fuzz()
    finally:
        shutil.rmtree(corpus, ignore_errors=True)


if __name__ == "__main__":
    main()
