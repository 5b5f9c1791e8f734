"""No test asserts a duration or races a process.

A profile counts work in calls, and `tests/patience.py` waits for what is to
happen. So no test reads a clock or gives up after a time of its own.
"""

import ast
import pathlib
import re

_ROOT = pathlib.Path(__file__).parent
_CLOCKS = ('time', 'timeit')
_WAITS = ('wait', 'join', 'result', 'settimeout', 'communicate', 'poll')
_TIMEOUTS = re.compile(r'timeout|.*_(seconds|ms)')


def _violations(source: str) -> list[str]:
  """Returns the parts of a test that depend on the speed of a machine."""
  found = []
  for node in ast.walk(ast.parse(source)):
    if isinstance(node, ast.Import):
      names = {alias.name for alias in node.names}
      found += [f'{node.lineno}: {name}' for name in names & set(_CLOCKS)]
    elif isinstance(node, ast.ImportFrom) and node.module in _CLOCKS:
      found.append(f'{node.lineno}: {node.module}')
    elif isinstance(node, ast.Call):
      given = [k.value for k in node.keywords if _is_timeout(k.arg)]
      if isinstance(node.func, ast.Attribute) and node.func.attr in _WAITS:
        given += node.args
      if any(_is_number(value) for value in given):
        found.append(f'{node.lineno}: {ast.unparse(node)[:60]}')
  return found


def _is_timeout(name: str | None) -> bool:
  return name is not None and bool(_TIMEOUTS.fullmatch(name))


def _is_number(node: ast.expr) -> bool:
  return isinstance(node, ast.Constant) and isinstance(node.value, int | float)


def test_no_test_depends_on_the_speed_of_the_machine():
  found = {
      path.name: violations
      for path in _ROOT.rglob('*_test.py')
      if (violations := _violations(path.read_text(encoding='utf-8')))
  }
  assert found == {}


def test_clocks_and_numeric_timeouts_are_found():
  for planted in (
      'import time',
      'from time import monotonic',
      'subprocess.run(command, timeout=60)',
      'ended.wait(timeout=5.0)',
      'future.result(5)',
      'in_thread(idle_seconds=0.3)',
  ):
    assert _violations(planted), planted
  for allowed in (
      'process.wait(patience.SECONDS)',
      "', '.join(parts)",
      'num_calls(function) <= 5',
  ):
    assert not _violations(allowed), allowed
