"""The notebook runs from its first cell to its last, in the shell of IPython, which notebooks run in."""

import json
import os
import subprocess
import sys
from pathlib import Path

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "notebook.ipynb"
RUN = """
import json
import sys
import urllib.request
from IPython.core.interactiveshell import InteractiveShell

shell, found = InteractiveShell.instance(), {}
for cell in json.load(open(sys.argv[1]))["cells"]:
    if cell["cell_type"] == "code":
        result = shell.run_cell("".join(cell["source"]))
        result.raise_error()
        if type(result.result).__name__ == "IFrame":
            with urllib.request.urlopen(result.result.src) as answer:
                found["page"] = [answer.status, answer.headers["Content-Security-Policy"].split("; ")[-1]]
found["paths"] = len(shell.user_ns["axes"].lines)
found["candidates"] = len(shell.user_ns["plan"].positions)
print(json.dumps(found))
"""


def test_the_notebook_plans_plots_and_shows_the_page(tmp_path: Path):
    command = [sys.executable, "-c", RUN, str(NOTEBOOK)]
    environment = {**os.environ, "MPLBACKEND": "agg"}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    planned, *_, q_track, last = result.stdout.splitlines()
    assert planned.startswith("OK ") and q_track == "8.0"
    found = json.loads(last)
    assert found["paths"] == found["candidates"] + 1 == 17
    assert found["page"] == [200, "frame-ancestors http://localhost:8888"]


def test_the_notebook_holds_no_output_and_is_short():
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    assert sum(len(cell["source"]) for cell in cells) < 60
