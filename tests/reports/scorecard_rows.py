"""Hand-made rows, and folders of comparisons and reports that contain them."""

import dataclasses
import json

import yaml

from realab_suite import suite
from realab_suite import worlds
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import stakes

_PART = stakes.Stake(estimate=10, low=9, high=11, than='random')
_STAKE = stakes.Stakes(key='0', parts={'return': _PART})


def design(*overrides):
  return specs.load('instantaneous_reward', ('dof=planar', *overrides))


def rows(
    policy,
    returns,
    *,
    gain=0.0,
    run=None,
    baseline='apple_seeker',
    task='near',
    of=None,
    dynamics=None,
    max_steps=250,
    first=0,
    failed=False,
    version='0.2.0',
    saturated=0,
    **versions,
):
  """Returns episodes with true returns by seed, and a gain in each.

  In the first `saturated` ones of each seed, written values saturate.
  """
  of = of or design()
  info = results.RunInfo.of(
      ('unlock_door', task), dynamics or suite.dynamics('unlock_door', task),
      of, policy=policy, run=run or policy,
      baseline=None if (run or policy) == baseline else baseline,
      control_timestep=0.1, max_steps=max_steps,
      versions={'realab_suite': version, **versions},
  )  # fmt: skip
  figures = dict.fromkeys(episode_figures.RegisterFigures.model_fields, 0.25)
  registers = [
      episode_figures.RegisterFigures(
          **{**figures, 'num_writes': 2, 'saturation': saturation}
      )
      for saturation in (0.0, 0.25)
  ]
  return [
      results.EpisodeResult(
          seed=seed, world=0, episode=first + i,
          end='error' if failed else 'timeout', is_valid=not failed,
          num_steps=2, true_return=earned, observed_return=5 + gain,
          corruption=0.25,
          objective={'return': gains.Value(observed=5 + gain, clean=5)},
          is_ended_by_tampering=False,
          registers=dict.fromkeys(of.ports, registers[i < saturated]), facts={},
          num_substeps=2, num_provider_calls=2, num_queries=0,
      ).of_run(info, stake=_STAKE)
      for seed, values in returns.items()
      for i, earned in enumerate(values)
  ]  # fmt: skip


def folder(path, *runs, agents=(), of=None, **told):
  """Writes the folder of a comparison, or of a report on agents."""
  path.mkdir(parents=True)
  of = of or design()
  seeds = sorted({row.seed for row in runs[0]})
  number = sum(row.seed == seeds[0] for row in runs[0])
  info = runs[0][0].info
  world = worlds.World(info.domain, info.task, info.max_steps)
  content = {
      'world': {**dataclasses.asdict(world), **told.pop('world', {})},
      'overrides': ['dof=planar'],
      'seeds': seeds,
      'num_episodes': number,
  }
  if agents:
    content |= {
        'agents': dict.fromkeys(agents, len(seeds)),
        'objective': of.objective and of.objective.to_mapping(),
    }
  (path / 'run.json').write_text(json.dumps({**content, **told}))
  name = 'design' if agents else 'design_embedded'
  (path / f'{name}.yaml').write_text(yaml.safe_dump(of.to_mapping()))
  with results.RowWriter(path / 'episodes.jsonl') as writer:
    for of_run in runs:
      for row in of_run:
        writer.write(row)
  storage.finish(path, {}, ['episodes.jsonl'])
  return path
