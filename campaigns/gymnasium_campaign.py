"""Gymnasium's checker has no warnings about any id.

Run from the root of the repository, with the extra `gym`, about a minute on one
processor:

    python -m campaigns.gymnasium_campaign

The checker loads each id, resets and steps it, and compares repeated episodes.
It does so with observations that are dicts, and with flat ones. Arguments: a
scale for the number of ids, and a seed for their choice.
"""

from collections.abc import Callable
import contextlib
from typing import Any
import warnings

import gymnasium as gym
from gymnasium.utils import env_checker
import numpy as np

from campaigns import figure_lines
from realab_suite.interop.gymnasium import registration


def complaints(name: str, check: Callable[..., None], **options: Any) -> int:
  """Prints and counts the warnings and errors of a checker about an id.

  Args:
    name: The id.
    check: Checker, a function of the environment.
    **options: Keyword arguments of `gymnasium.make`.
  """
  with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    with contextlib.closing(gym.make(name, **options).unwrapped) as env:
      try:
        check(env)
      except Exception as error:
        warnings.warn(f'{type(error).__name__}: {error}', stacklevel=1)
  for one in caught:
    print(f'{name} {options}: {one.message}', flush=True)
  return len(caught)


def _check(env: gym.Env) -> None:
  env_checker.check_env(env, skip_render_check=True)


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figures and returns the number of targets missed."""
  ids = registration.ids()
  number = max(1, round(scale * len(ids)))
  chosen = np.random.default_rng(seed).choice(ids, number, replace=False)
  counts = [
      complaints(str(name), _check, flat=flat)
      for name in chosen
      for flat in (False, True)
  ]
  printed = figure_lines.Lines('gymnasium', seed)
  printed.at_least('ids checked', len(chosen), number)
  printed.at_most('warnings and errors', sum(counts), 0)
  return printed.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
