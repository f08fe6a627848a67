"""The tutorials as a set: every equation once, beside its call; assertions, exercises,
links.  nbmake runs the cells."""

import ast
import json
import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
STAGES = tuple(sorted(FOLDER.glob("1[0-8]_*.ipynb")))  # the first paper, without map and inspector
POINTS = tuple(sorted(FOLDER.glob("2[0-9]_*.ipynb")))  # the second paper
TAUGHT = (*STAGES, FOLDER / "19_collision_inspector.ipynb", *POINTS)
ALL = (FOLDER / "00_map.ipynb", *TAUGHT)
EQUATIONS, EQUATIONS_OF_POINTS = range(1, 19), range(1, 8)
TAG = re.compile(r"\\tag\{(\d+)\}")
SOLUTION = re.compile(r"<details><summary>Solution</summary>(.*?)</details>", re.DOTALL)

each = pytest.mark.parametrize("path", ALL, ids=lambda path: path.stem)
each_taught = pytest.mark.parametrize("path", TAUGHT, ids=lambda path: path.stem)


def cells_of(path: Path) -> list[dict]:
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def text_of(cell: dict) -> str:
    return "".join(cell["source"])


def code_of(path: Path) -> list[str]:
    return [text_of(cell) for cell in cells_of(path) if cell["cell_type"] == "code"]


def test_every_equation_of_the_first_paper_stands_once():
    first = [path for path in ALL if path not in POINTS]
    numbers = [int(n) for path in first for cell in cells_of(path) for n in TAG.findall(text_of(cell))]
    assert sorted(numbers) == list(EQUATIONS)


def test_every_equation_of_the_second_paper_stands_once():
    numbers = [int(n) for path in POINTS for cell in cells_of(path) for n in TAG.findall(text_of(cell))]
    assert sorted(numbers) == list(EQUATIONS_OF_POINTS)


@pytest.mark.parametrize("path", [*STAGES, *POINTS], ids=lambda path: path.stem)
def test_an_equation_has_its_heading_and_section_and_its_call_follows(path):
    cells = cells_of(path)
    for cell, after in zip(cells, [*cells[1:], None]):
        for number in TAG.findall(text_of(cell)):
            assert re.search(rf"^## Eq\. {number} \(Sec\. \d(\.\d)?\): ", text_of(cell), re.MULTILINE)
            assert after is not None
            assert after["cell_type"] == "code"


def test_the_stages_are_there():
    assert [path.stem[:2] for path in STAGES] == [str(n) for n in range(10, 19)]
    assert [path.stem[:2] for path in POINTS] == [str(n) for n in range(20, 28)]


@each
def test_no_outputs_are_committed(path):
    for cell in cells_of(path):
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


@each
def test_the_last_code_cell_asserts_what_can_fail(path):
    asserted = [node.test for node in ast.parse(code_of(path)[-1]).body if isinstance(node, ast.Assert)]
    assert asserted
    assert not any(isinstance(test, ast.Constant) for test in asserted)


@each
def test_cells_define_nothing(path):
    for code in code_of(path):
        plain = "\n".join(line for line in code.splitlines() if not line.startswith("%"))
        defined = (ast.FunctionDef, ast.ClassDef, ast.Lambda)
        assert not any(isinstance(node, defined) for node in ast.walk(ast.parse(plain)))
        assert "sys.path" not in plain


@each
def test_links_between_notebooks_resolve(path):
    targets = [t for cell in cells_of(path) for t in re.findall(r"\]\(([^)#\s]+\.ipynb)\)", text_of(cell))]
    missing = [target for target in targets if not (FOLDER / target).is_file()]
    assert not missing


def test_the_map_links_to_every_stage():
    linked = set(re.findall(r"\]\(([^)]+\.ipynb)\)", "".join(text_of(cell) for cell in cells_of(ALL[0]))))
    assert {path.name for path in TAUGHT} <= linked


@each_taught
def test_two_or_three_exercises_with_folded_solutions(path):
    text = "\n".join(text_of(cell) for cell in cells_of(path) if cell["cell_type"] == "markdown")
    solutions = SOLUTION.findall(text)
    assert 2 <= len(solutions) <= 3
    assert len(solutions) == len(re.findall(r"^\*\*\d\.\*\*", text, re.MULTILINE)) == text.count("</details>")
    for block in re.findall(r"```python\n(.*?)```", "\n".join(solutions), re.DOTALL):
        ast.parse(block)
