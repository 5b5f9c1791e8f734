"""Draws the dial of coupling from published rows.

Run from the root of the repository:

    python docs/results/dial_figure.py docs/results/dial docs/images/dial.png

The axis has the share of the crates that are base blocks of registers. A dot is
the mean of a seed, and lines join the means of seeds.
"""

import pathlib
import sys

import matplotlib
from matplotlib import figure
import pandas as pd

import realab_suite as realab
from realab_suite.reports import plots

_SHARES = {point: point / 4 for point in range(5)}
# Names of runs, without their points, with a text and a marker.
_ACTORS = {
    'reward_{}': ('reward learner', 'o'),
    'reward_{}.transplant': ('twin, with the blocks in reach', '^'),
    'reward_{}.secure': ('secure twin', 'v'),
    'reward_{}.solver': ('solver', 's'),
    'decoupled_{}': ('decoupled approval', 'D'),
}
# Columns, and the actors for whom they are drawn: the readings of decoupled
# approval are in units of approval.
_PANELS = {
    'true_return': ('true return (of 4)', tuple(_ACTORS)),
    'observed_return': ('observed return', tuple(_ACTORS)[:-1]),
}


def draw(rows: pd.DataFrame) -> figure.Figure:
  """Draws true and observed returns along the dial.

  Args:
    rows: Episodes of the experiment `dial`, as `realab.read_study` has them.
  """
  means = rows.groupby(['run', 'seed'])[list(_PANELS)].mean()
  canvas = figure.Figure(figsize=(9.5, 4.2), layout='constrained')
  for axes, (column, (title, actors)) in zip(
      canvas.subplots(1, len(_PANELS)), _PANELS.items(), strict=True
  ):
    for number, actor in enumerate(actors):
      text, marker = _ACTORS[actor]
      of_share = {
          share: means.loc[actor.format(point), column]
          for point, share in _SHARES.items()
      }
      axes.plot(
          list(of_share), [seeds.mean() for seeds in of_share.values()],
          color=f'C{number}', label=text, marker=marker, markevery=[],
      )  # fmt: skip
      for share, seeds in of_share.items():
        axes.plot(
            [share] * len(seeds), seeds,
            color=f'C{number}', marker=marker, linestyle='', alpha=0.6,
        )  # fmt: skip
    axes.set_title(title)
    axes.set_xticks(list(_SHARES.values()))
    axes.set_xlabel('share of crates that are registers')
  canvas.legend(
      *canvas.axes[0].get_legend_handles_labels(),
      loc='outside lower center', ncols=3,
  )  # fmt: skip
  return canvas


def main() -> None:
  """Draws the picture."""
  folder, output = map(pathlib.Path, sys.argv[1:])
  with matplotlib.rc_context(plots.STYLE):
    canvas = draw(realab.read_study(folder).rows)
    canvas.savefig(output, dpi=120, metadata={'Software': None})


if __name__ == '__main__':
  main()
