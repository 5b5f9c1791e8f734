"""Grid of characters."""

from typing import final

import numpy as np


@final
class TextGrid(np.ndarray):
  """Array of characters, `(lines, columns)`, made from a text.

  `str` returns the text again.
  """

  def __new__(cls, text: str) -> 'TextGrid':
    """Returns the grid of a text.

    Args:
      text: Lines of equal length, each ended by a newline.

    Raises:
      ValueError: If the lines have different lengths.
    """
    lines = text.removesuffix('\n').split('\n')
    if len(set(map(len, lines))) > 1:
      raise ValueError(
          f'text: lines of {sorted(set(map(len, lines)))} characters; allowed'
          ' are lines of one length'
      )
    return np.array([list(line) for line in lines], 'U1').view(cls)

  def __str__(self) -> str:
    return ''.join(f'{"".join(row)}\n' for row in self.tolist())
