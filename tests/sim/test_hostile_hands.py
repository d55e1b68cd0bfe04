"""Hands' files that try to harm have no effect."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from xml.sax.saxutils import escape

import pytest
from urdf_text import SMALL_HAND, xacro_hand

from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription
from grasp_env.sim.hand.files import xacro


def quoted(text: str) -> str:
    return escape(text, {'"': "&quot;"})


def value(expression: str) -> str:
    """A hand whose name is the value of an expression."""
    return xacro_hand(name=f"${{{quoted(expression)}}}")


def late(text: str, use: str) -> str:
    """A hand whose name is `use`, of a property p with a text; xacro evaluates such texts twice."""
    return xacro_hand(f'<xacro:property name="p" value="{quoted(text)}"/>', use)


class Trap:
    """A folder with a secret file outside the hand's own; it notices each process that opens the
    file."""

    def __init__(self, folder: Path) -> None:
        self.outside = folder / "outside"
        self.own = folder / "own"
        self.marker = folder / "marker"
        self.outside.mkdir()
        (self.own / "parts").mkdir(parents=True)
        self.secret = self.outside / "secret.yaml"
        os.mkfifo(self.secret)
        self.opened = threading.Event()
        self._watch = threading.Thread(target=self._wait)
        self._watch.start()

    def _wait(self) -> None:
        os.close(os.open(self.secret, os.O_WRONLY))  # until a reader opens it
        self.opened.set()

    def close(self) -> None:
        reader = os.open(self.secret, os.O_RDONLY | os.O_NONBLOCK)
        self._watch.join()
        os.close(reader)

    def link(self, name: str, to: Path) -> None:
        (self.own / name).symlink_to(to)

    def write(self, name: str, text: str) -> None:
        (self.own / name).write_text(text)


@pytest.fixture
def trap(tmp_path, monkeypatch):
    monkeypatch.setenv("GRASP_SECRET", "the-secret")
    trap = Trap(tmp_path)
    yield trap
    trap.close()


FRAME = "[[g.append((x.gi_frame.f_back.f_back.f_back.f_globals for x in g)), list(g[0])[0]['os'].system('touch {}')] for g in [[]]]"
CLASSES = "python.vars(python.type)['__subclasses__'](python.vars(python.type)['mro'](int)[1])"
BRANCHES = '<xacro:macro name="m0"><link name="l"/></xacro:macro>' + "".join(
    f'<xacro:macro name="m{i}">{f"<xacro:m{i - 1}/>" * 10}</xacro:macro>' for i in range(1, 20)
)
NESTED = "".join(f'<xacro:macro name="m{i}">' for i in range(100_000)) + "</xacro:macro>" * 100_000
LAUGHS = '<xacro:property name="p0" value="ha"/>' + "".join(
    f'<xacro:property name="p{i}" value="{f"${{p{i - 1}}}" * 10}"/>' for i in range(1, 20)
)
OUTSIDE = "which is neither beside it nor in a package that"

HOSTILE: dict[str, tuple[str | Callable[[Trap], str], str]] = {
    # a command
    "frame of a generator": (
        lambda trap: value(FRAME.format(trap.marker)),
        "reads the attribute 'f_globals', which",
    ),
    "frame in other letters": (
        value("(i for i in [1]).\uff47i_frame"),
        "reads the attribute 'gi_frame', which",
    ),
    "globals of a function": (
        lambda trap: value(f"xacro.load_yaml.__globals__['os'].system('touch {trap.marker}')"),
        "reads the attribute '__globals__'",
    ),
    "a lambda": (value("(lambda: 1)()"), "has the Python syntax Lambda"),
    "classes without an attribute": (
        lambda trap: value(
            f"[c for c in {CLASSES} if 'Popen' in str(c)][0](['touch', '{trap.marker}']).wait()"
        ),
        "'vars' is not defined",
    ),
    "a text that names attributes": (
        late("{0.__class__}", "${p.format(1)}"),
        "reads the attribute 'format' of type str",
    ),
    "an argument that is an f-string": (
        xacro_hand('<xacro:arg name="a" default="f\'{len!r}\'"/>', "${$(arg a)}"),
        "has the Python syntax JoinedStr",
    ),
    "functions of $(eval)": (
        lambda trap: late(
            f"exec('import os; os.system(\"touch {trap.marker}\")', dict())", "$(eval ${p})"
        ),
        "name 'exec' is not defined",
    ),
    "a condition": (
        xacro_hand('<xacro:if value="${().__class__}"/>'),
        "reads the attribute '__class__', which",
    ),
    "a block that is evaluated twice": (
        xacro_hand(
            '<xacro:macro name="m" params="*b"><xacro:insert_block name="b"/></xacro:macro><xacro:m><x y="${\'$\'}{len.__self__}"/></xacro:m>'
        ),
        "reads the attribute '__self__'",
    ),
    "an object in YAML": (
        lambda trap: (
            trap.write("a.yaml", f"!!python/object/apply:os.system ['touch {trap.marker}']")
            or value("xacro.load_yaml('a.yaml')")
        ),
        "could not determine a constructor for the tag",
    ),
    "a unit in YAML": (
        lambda trap: (
            trap.write("a.yaml", "a: !degrees (i for i in [1]).gi_frame")
            or value("load_yaml('a.yaml')")
        ),
        "reads the attribute 'gi_frame'",
    ),
    # a file
    "a file": (lambda trap: value(f"xacro.load_yaml('{trap.secret}')"), OUTSIDE),
    "a relative name": (value("list(map(load_yaml, ['../own/../outside/secret.yaml']))"), OUTSIDE),
    "the environment as a file": (value("load_yaml('/proc/self/environ')"), OUTSIDE),
    "a link": (
        lambda trap: trap.link("a.yaml", trap.secret) or value("load_yaml('a.yaml')"),
        OUTSIDE,
    ),
    "a link to a folder": (
        lambda trap: (
            trap.link("a", trap.outside) or xacro_hand('<xacro:include filename="*/secret.yaml"/>')
        ),
        OUTSIDE,
    ),
    "a link to a package": (
        lambda trap: (
            trap.link("package.xml", trap.secret)
            or value("load_yaml('$(find outside)/secret.yaml')")
        ),
        "the package 'outside' is in none",
    ),
    "a hidden file": (
        lambda trap: trap.link(".ssh", trap.outside) or value("load_yaml('.ssh/secret.yaml')"),
        OUTSIDE,
    ),
    "functions of $(eval) for files": (
        lambda trap: late(f"open('{trap.secret}').read()", "$(eval ${p})"),
        "name 'open' is not defined",
    ),
    "an include": (
        lambda trap: xacro_hand(f'<xacro:include filename="{trap.secret}" optional="true"/>'),
        OUTSIDE,
    ),
    "an include of a pattern": (
        xacro_hand('<xacro:include filename="*/../../outside/*.yaml" ns="n"/>'),
        OUTSIDE,
    ),
    "an entity in an include": (
        lambda trap: (
            trap.write("a.xacro", f'<!DOCTYPE r [<!ENTITY x SYSTEM "{trap.secret}">]><r>&x;</r>')
            or xacro_hand('<xacro:include filename="a.xacro"/>')
        ),
        "it holds a DOCTYPE",
    ),
    "a package by its path": (
        value("load_yaml('$(find ../outside)/secret.yaml')"),
        "the package '../outside' is in none",
    ),
    # a variable
    "a variable": (
        xacro_hand(name="$(env GRASP_SECRET)"),
        "reads the environment variable 'GRASP_SECRET', which is not allowed",
    ),
    "functions of $(eval) for variables": (
        late("env('GRASP_SECRET')", "$(eval ${p})"),
        "reads the environment variable",
    ),
    # memory
    "a long text": (value("'a' * 10**11"), "it needs too much memory"),
    "a long format": (value("'%100000000000d' % 1"), "it needs too much memory"),
    "texts of texts": (xacro_hand(LAUGHS, "${p19}"), "it needs too much memory"),
    "a long file": (
        xacro_hand(
            '<xacro:property name="p" value="${\'a\' * 10**7}"/><x a="${p}" b="${p}" c="${p}"/>'
        ),
        "it becomes more than 20 MB",
    ),
    # time
    "a large number": (value("9**9**9"), "has a whole number of more than 100000 bits"),
    "a macro that calls itself": (
        xacro_hand('<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>'),
        "nested too deep, or a macro calls itself",
    ),
    "a file that includes itself": (
        xacro_hand('<xacro:include filename="hand.xacro"/>'),
        "nested too deep",
    ),
    "a property of itself": (late("${p}", "${p}"), "circular variable definition"),
    "100,000 nested macros": (xacro_hand(NESTED), "nested too deep"),
    "10^19 calls of macros": (xacro_hand(f"{BRANCHES}<xacro:m19/>"), "it took more than"),
    "a large factorial": (value("factorial(10**9)"), "it took more than"),
    "a long loop": (
        value("[0 for a in range(10**9) for b in range(10**9) if 0]"),
        "it took more than",
    ),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_have_no_effect(kind, trap, monkeypatch):
    make, message = HOSTILE[kind]
    if message == "it took more than":
        monkeypatch.setattr(xacro, "_SECONDS", 2.0)
    path = trap.own / "hand.xacro"
    path.write_text(make if isinstance(make, str) else make(trap), encoding="utf-8")
    begin = time.monotonic()
    with pytest.raises(InvalidInputError) as told:
        HandDescription.from_file(path)
    assert time.monotonic() - begin < 25.0
    assert str(told.value).startswith(f"{path}: xacro cannot expand {path}: ")
    assert message in str(told.value)
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 800
    assert "the-secret" not in str(told.value)
    assert not trap.marker.exists()
    assert not trap.opened.is_set()


@pytest.mark.parametrize(
    "name", ["innocent.urdf", "innocent.xml", "innocent", "innocent.xacro.urdf"]
)
def test_only_xacro_files_are_expanded(trap, name):
    """`xacro=True` expands others, and nothing else is allowed in those."""
    (trap.own / name).write_text(value(FRAME.format(trap.marker)))
    with pytest.raises(
        InvalidInputError,
        match=r"it has xacro elements, but .* rename it to \.xacro, or pass xacro=True$",
    ):
        HandDescription.from_file(trap.own / name)
    with pytest.raises(InvalidInputError, match="'f_globals'"):
        HandDescription.from_file(trap.own / name, xacro=True)
    plain = SMALL_HAND.replace('name="small"', 'name="${1 + 1} $(env GRASP_SECRET)"')
    (trap.own / name).write_text(plain)
    assert HandDescription.from_file(trap.own / name).name == "${1 + 1} $(env GRASP_SECRET)"
    assert not trap.marker.exists()


def test_no_variable_is_seen(trap):
    names = ("GRASP_SECRET", "HOME", "PATH", "PYTHONPATH", "LC_CTYPE", "LD_LIBRARY_PATH")
    (trap.own / "hand.xacro").write_text(
        xacro_hand(name="".join(f"$(optenv {name} -)" for name in names))
    )
    assert HandDescription.from_file(trap.own / "hand.xacro").name == "-" * len(names)


def test_the_second_barrier(trap):
    """The codec of a text is a module; nothing is imported while xacro runs."""
    (trap.own / "hand.xacro").write_text(value("'a'.encode('this')"))
    with pytest.raises(
        InvalidInputError, match="it does 'import' in the interpreter, which is not allowed"
    ):
        HandDescription.from_file(trap.own / "hand.xacro")
