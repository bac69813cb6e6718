"""A build's code is what it reaches by name: all of that, and nothing beside it."""

from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

from catalog.code_closure import SourceTree
from catalog.errors import IdentityError

TOY = {
    "__init__.py": '"""A toy."""\n',
    "stage.py": '''
"""A stage."""
import numpy as np
from harness import run_stage
from toy.settings import Settings, unused_setting
from toy import drawing
from toy.numbers import half as halved

SCALE = 2

def decorated(function):
    return function

@decorated
def build(place, *, settings: Settings, told=None, note: "Noted" = None):
    """Build."""
    scale = SCALE
    beside = [beside for beside in range(scale)]
    return drawing.draw(halved(np.float32(scale)), beside)

class Noted:
    text = "noted"

def beside():
    return run_stage(build)

def late():
    from toy.late import later
    return later()

def by_name():
    return import_module("toy.named")

def count(step):
    return step + 1
''',
    "settings.py": "class Base:\n    a = 1\nclass Settings(Base):\n    b = 2\nunused_setting = 3\n",
    "drawing.py": "from toy.kernels.splat import splat\ndef draw(x, y):\n    return splat(x)\n"
    "def erase():\n    return 0\n",
    "numbers.py": "def half(x):\n    return x / 2\ndef third(x):\n    return x / 3\n",
    "late.py": "registry = {}\nregistry['later'] = 1\ndef later():\n    return 4\n",
    "named.py": "def anything():\n    return 5\n",
    "kernels/__init__.py": "",
    "kernels/backends.py": "from importlib import import_module\n"
    "def implementation(kernel, name):\n"
    "    return import_module(f'toy.kernels.{kernel}.{name}').run\n",
    "kernels/splat/__init__.py": "from toy.kernels.backends import implementation\n"
    "def splat(x):\n    return implementation('splat', 'cpu')(x)\n"
    "def other(x):\n    return x\n",
    "kernels/splat/cpu.py": "from toy.kernels.splat.lanes import add\ndef run(x):\n"
    "    return add(x, 1)\n",
    "kernels/splat/lanes.py": "def register(what):\n    return lambda one: one\nclass Lane:\n"
    "    width = 8\n@register(Lane)\nclass Model:\n    size = 4\ndef add(x, y):\n"
    "    return Lane, x + y\n",
    "kernels/blend/__init__.py": "from toy.kernels.backends import implementation\n"
    "def blend(x):\n    return implementation('blend', 'cpu')(x)\n",
    "kernels/blend/cpu.py": "def run(x):\n    return x\n",
}


@pytest.fixture
def toy(tmp_path):
    for name, text in TOY.items():
        (tmp_path / "toy" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "toy" / name).write_text(text)
    return tmp_path / "toy"


def code_of(toy, *names):
    return SourceTree({"toy": toy}).code_from(f"toy.stage:{name}" for name in names or ["build"])


def change(toy, name, old, new):
    text = (toy / name).read_text()
    assert old in text
    (toy / name).write_text(text.replace(old, new, 1))


def test_a_build_reaches_its_names_and_the_backends_of_the_kernels_it_calls(toy):
    assert set(code_of(toy).modules) == {
        "toy.stage",
        "toy.settings",
        "toy.drawing",
        "toy.numbers",
        "toy.kernels.backends",
        "toy.kernels.splat",
        "toy.kernels.splat.cpu",
        "toy.kernels.splat.lanes",
    }


def test_imports_inside_functions_and_by_name_count(toy):
    assert set(code_of(toy, "late").modules) == {"toy.stage", "toy.late"}
    assert set(code_of(toy, "by_name").modules) == {"toy.stage", "toy.named"}


def test_comments_docstrings_and_layout_change_nothing(toy):
    before = code_of(toy)
    for path in toy.rglob("*.py"):
        path.write_text(f"\n\n{path.read_text()}\n# a comment\n")
    change(toy, "stage.py", '"""A stage."""', '"""Another word for it."""')
    change(toy, "stage.py", '"""Build."""', '"""Build it\n    well."""')
    change(toy, "drawing.py", "def draw(x, y):", "def draw(\n    x,  # a place\n    y,\n):")
    change(toy, "settings.py", "a = 1", 'a = (1)\n    """A number."""')
    assert code_of(toy) == before


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("stage.py", "SCALE = 2", "SCALE = 3"),  # a constant
        ("stage.py", "return function", "return lambda *a: function(*a)"),  # a decorator
        ("stage.py", "@decorated\n", ""),
        ("stage.py", "told=None", "told=print"),  # a default
        ("stage.py", 'text = "noted"', "text = ''"),  # an annotation in quotes
        ("stage.py", "import numpy as np", "import cupy as np"),  # what a name stands for
        ("settings.py", "a = 1", "a = 2"),  # the base of an annotation
        ("numbers.py", "x / 2", "x / 4"),
        ("drawing.py", "def erase", "print('imported')\ndef erase"),  # what runs at import
        ("__init__.py", '"""A toy."""', "import os\nos.environ['A'] = 'b'"),  # of a package too
        ("kernels/backends.py", ".run", ".walk"),
        ("kernels/splat/cpu.py", "x, 1", "x, 2"),  # a backend
        ("kernels/splat/lanes.py", "width = 8", "width = 16"),
        ("kernels/splat/lanes.py", "size = 4", "size = 8"),  # registered with what is reached
    ],
)
def test_what_a_build_reaches_changes_its_code(toy, name, old, new):
    before = code_of(toy)
    change(toy, name, old, new)
    after = code_of(toy)
    assert after.digest != before.digest
    changed = {one for one in after.modules if after.modules[one] != before.modules.get(one)}
    module = ".".join(["toy", *name.removesuffix(".py").split("/")]).removesuffix(".__init__")
    assert module in changed
    assert len(changed) == 1


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("stage.py", "return run_stage(build)", "return None"),  # of a name that is local above
        ("stage.py", "return step + 1", "return step"),
        ("settings.py", "unused_setting = 3", "unused_setting = 4"),
        ("numbers.py", "x / 3", "x / 5"),
        ("drawing.py", "return 0", "return 1"),
        ("kernels/splat/__init__.py", "return x\n", "return -x\n"),
        ("kernels/blend/cpu.py", "return x", "return -x"),  # another kernel's backend
        ("late.py", "return 4", "return 5"),
    ],
)
def test_what_a_build_does_not_reach_changes_nothing(toy, name, old, new):
    before = code_of(toy)
    change(toy, name, old, new)
    assert code_of(toy) == before


def test_functions_and_objects_bound_to_a_build_count(toy, monkeypatch):
    monkeypatch.syspath_prepend(toy.parent)
    tree = SourceTree({"toy": toy})
    settings, numbers = import_module("toy.settings"), import_module("toy.numbers")
    bound = partial(numbers.half, numbers.third, settings.Settings(), Path("a"), 3)
    assert tree.code(bound).starts == (
        "toy.numbers:half",
        "toy.numbers:third",
        "toy.settings:Settings",
    )


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("stage.py", "from toy.gone import x\ndef build(): x\n", "toy.gone, which has no source"),
        (
            "stage.py",
            "from toy.numbers import gone\ndef build(): gone\n",
            "'gone' from toy.numbers",
        ),
        ("stage.py", "def built(): pass\n", "toy.stage has no 'build'"),
        ("stage.py", "def build(:\n", "stage.py has no digest"),
        (
            "stage.py",
            "from toy.kernels.backends import implementation\ndef build():\n"
            "    return implementation('splat', 'cpu')\n",
            "asks for toy.kernels",
        ),
    ],
)
def test_code_that_cannot_be_found_is_an_error(toy, name, text, message):
    (toy / name).write_text(text)
    with pytest.raises(IdentityError, match=message):
        code_of(toy)


def test_a_method_or_a_function_of_nowhere_is_an_error(toy):
    tree = SourceTree({"toy": toy})
    with pytest.raises(IdentityError, match="no function of a module"):
        tree.code("text".join)
    with pytest.raises(IdentityError, match="no source of"):
        tree.code(change)


def test_an_outline_kept_beside_the_bytecode_follows_the_source(toy):
    first = code_of(toy)
    assert list(toy.rglob("__pycache__/*.outline.json"))
    assert code_of(toy) == first
    change(toy, "numbers.py", "x / 2", "x / 8")
    assert code_of(toy) != first
    change(toy, "numbers.py", "x / 8", "x / 2")
    for kept in toy.rglob("*.outline.json"):
        kept.write_text("{")
    assert code_of(toy) == first
