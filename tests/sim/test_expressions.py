"""Expressions of xacro files have Python's values or are refused."""

from __future__ import annotations

import math
from typing import Any

import pytest

from grasp_env.sim.hand.files.expressions import RefusedError, evaluate


class Dotted(dict[str, Any]):
    """A dict of dotted names, as those of xacro."""

    def __getattr__(self, name: str) -> Any:
        return self[name]


BUILTINS = (list, dict, set, sorted, zip, map, len, str, max, isinstance, range, all, any, sum, int)
SYMBOLS: dict[str, Any] = {
    **{each.__name__: each for each in BUILTINS},
    "pi": math.pi,
    "cos": math.cos,
    "side": "left",
    "fingers": ["th", "ff", "mf"],
    "_spare_": None,
    "size": 0.03,
    "limits": Dotted(lower=-1, upper=2.5, inner=Dotted(items_=3)),
    "table": {"a": {"b": [1, 2, 3]}},
}
SAME = """
-pi / 4
2 * (size + 0.001) ** 2 - 7 // 2 % 3
+3 - ~5 & 6 | 8 ^ 1 << 3 >> 1
'{}' + side
'%s_%d' % (side, 3)
1 if side == 'left' else -1
side.upper()[0] + side[1:] + side[::-1] + side[-2:None:1]
side in ['left', 'right'] and 'ff' not in fingers or not fingers
1 < 2 <= 2 != 3 > 2 >= 1
1 < 0 < undefined
_spare_ is None and side is not None
0 or '' or 'last'
1 and [] and undefined
[f.upper() for f in fingers if f != 'th' if f]
[(i, j) for i in range(3) for j in range(i)]
[x for x in [x for x in fingers]]
{name: index for index, name in zip(range(3), fingers)}
{f[0] for f in fingers}
sum(i * i for i in range(10))
any(sep in side for sep in ',; e')
all([isinstance(f, str) for f in fingers])
dict([(k.lower(), v) for k, v in {'A': 1, **table}.items()])['a']
list(set(fingers) - set(['th'])) != []
dict(lf='bt', **{'mf': 2})
[*fingers, 'rf', *range(2)]
max(*[1, 2], key=int)
sorted(fingers, reverse=True)
list(map(len, fingers))
limits.upper - limits.lower + limits.inner.items_
sorted(limits.keys())
table['a']['b'][-1]
(1,) + (2, 3)
{1, 2} | {3}
{'a': 1}.get('b', 2)
[[c for c in f] for f in fingers]
[a + b for a, (b, c) in zip([1, 2], [(3, 4), (5, 6)])]
(3).real + 0.5.is_integer()
True, False, None, 1.5e-3, 'text', 2j
"""


@pytest.mark.parametrize("text", SAME.strip().splitlines())
def test_a_value_is_that_of_python(text):
    expected = eval(text, {"__builtins__": {}, **SYMBOLS}, {})
    value = evaluate(f" {text}\n", SYMBOLS)
    assert value == expected
    assert type(value) is type(expected)


WRONG = """
undefined
1 +
1 / 0
fingers[9]
table['c']
side.none
limits.none
len()
'a' + 1
f for f in fingers
[a for a, b in [(1, 2, 3)]]
cos(x=1)
size()
"""


@pytest.mark.parametrize("text", WRONG.strip().splitlines())
def test_errors_are_those_of_python(text):
    with pytest.raises(Exception) as expected:  # noqa: PT011
        eval(text, {"__builtins__": {}, **SYMBOLS}, {})
    # xacro's dicts raise this one
    kind = AttributeError if text.startswith("limits") else expected.type
    if text == "side.none":  # of another value it could be harmful
        kind = RefusedError
    with pytest.raises(kind):
        evaluate(text, SYMBOLS)


REFUSED = """
().__class__
().__cl\uff41ss__
(1).__init__
side.__class__
len.__self__
limits.keys.__self__
[].append.__call__
(i for i in [1]).gi_frame
(i for i in [1]).\uff47i_frame
[i for i in [1]].gi_code
cos.__globals__
cos.f_back
str.mro()
str.format
dict.fromkeys('a')
side.format(1)
side.format_map({})
f'{side}'
f'{side.__class__}'
b''.decode
lambda: 1
(x := 1)
[0 for side.x in [1]]
[0 for table['x'] in [1]]
[x async for x in []]
[0 for *x, y in [[1]]]
__import__
__builtins__
side @ side
9**9**9
(-9)**(9**9)
1 << 10**10
2 ** 10**6
(...).x
yield_.x if 0 else (yield)
"""


@pytest.mark.parametrize("text", REFUSED.strip().splitlines())
def test_whatever_could_leave_the_data_is_refused(text):
    with pytest.raises(RefusedError, match=r"^the expression .*, which is not allowed$"):
        evaluate(text, {**SYMBOLS, "yield_": 1})


def test_results_have_no_way_out():
    """A comprehension in brackets is a list, so that no generator exists; what a function returns
    has no attributes."""
    assert evaluate("(i for i in [1, 2])", {}) == [1, 2]
    names = "__class__ __reduce__ gi_frame __self__ cr_frame tb_frame mro co_code ag_frame"
    for text in ("zip([1], [2])", "map(len, [])", "range", "limits.items"):
        evaluate(text, SYMBOLS)
        for name in names.split():
            with pytest.raises(RefusedError):
                evaluate(f"{text}.{name}", SYMBOLS)
