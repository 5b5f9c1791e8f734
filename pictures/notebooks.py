"""Notebooks as programs: the cells of a notebook, run in one process."""

import json
import pathlib
from typing import Any


def run(path: pathlib.Path) -> dict[str, Any]:
  """Runs the code cells of a notebook in order.

  Args:
    path: File of the notebook. Its stored outputs are not changed.

  Returns:
    The global names after the last cell.
  """
  names: dict[str, Any] = {'__name__': path.stem}
  for cell in _code_cells(path):
    exec(compile(''.join(cell['source']), path.name, 'exec'), names)
  return names


def printed(path: pathlib.Path) -> str:
  """Returns the text that the cells of a notebook have printed when stored."""
  return ''.join(
      line
      for cell in _code_cells(path)
      for output in cell['outputs']
      if output['output_type'] == 'stream'
      for line in output['text']
  )


def _code_cells(path: pathlib.Path) -> list[dict[str, Any]]:
  notebook = json.loads(path.read_text(encoding='utf-8'))
  return [cell for cell in notebook['cells'] if cell['cell_type'] == 'code']
