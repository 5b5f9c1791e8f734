"""Campaigns C09, C44: tests find leaks and bugs planted on purpose.

Run from the root of the repository, about half an hour:

    python -m campaigns.mutants_campaign [scale] [seed]

Each bug of `MUTANTS` is one change to the text of a copy of the package
(`planting.py`), on which its tests have to fail. The description of a bug that
is a fault of another package begins with the number of the finding.

mutmut 3.8 does not replace the list: of 39 bugs listed for six files, none is
among the 1,511 that it makes of them, and its copies of methods and its frames
of tracebacks fail the tests of the agent's view before any bug is planted.
"""

import pathlib
import tempfile

import numpy as np

from campaigns import figure_lines
from campaigns import planting

_ENVIRONMENT = 'engine/environment.py'
_CONTROL_STEP = 'engine/control_step.py'
_HANDS = 'tests/entities/moving_test.py', 'tests/entities/carrying_test.py'
_EPISODES = 'engine/episodes.py'
_HOSTS = 'engine/hosts.py'
_OBSERVING = 'engine/observing.py'
_ENV = (
    'tests/engine/environment_test.py',
    'tests/engine/recovery_test.py',
    'tests/engine/bad_actions_test.py',
    'tests/engine/foreign_feedback_test.py',
)
_ACTIONS = 'engine/action_codec.py'
_MECH = ('tests/feedback/mechanism_test.py',)
_CHECKS = 'entities/registers/checks.py'
_TWO_BLOCK = 'entities/registers/two_block.py'
_REG = ('tests/authors/registers_test.py',)
_TWO = ('tests/entities/two_block_register_test.py',)
_FIGURES = 'evaluation/episode_figures.py'
_GAINS = 'evaluation/gains.py'
_FIG = ('tests/evaluation/episode_figures_test.py',)
_CLEAN = 'feedback/clean_contents.py'
_ORACLE = ('tests/feedback/clean_oracle_test.py',)
_LED = ('tests/evaluation/ledger_test.py', *_FIG)
_COMPARISON = 'lab/verdicts/comparison.py'
_COM = ('tests/lab/verdicts/comparison_test.py',)
_STUDY = 'lab/verdicts/study.py'
_STU = ('tests/lab/verdicts/study_test.py', '-k', 'cannot_be_judged')
_STORAGE = 'lab/experiments/storage.py'
_TRA = ('tests/lab/experiments/training_test.py',)
_STO = ('tests/lab/experiments/storage_test.py', *_TRA)
_RESULTS = 'evaluation/results.py'
_RES = ('tests/evaluation/results_test.py',)
_ENDINGS = 'evaluation/endings.py'
_END = ('tests/evaluation/endings_test.py', '-k', 'every_end')
_INTERVALS = 'lab/verdicts/intervals.py'
_INT = ('tests/lab/verdicts/intervals_test.py',)
_VIEW = 'engine/agent_view.py'
_PAIRS = ('tests/leaks/pairs_test.py',)
_VIEWS = ('tests/leaks/agent_view_test.py',)
_FAILURES = ('tests/leaks/failures_test.py',)
_VERDICTS = 'lab/verdicts/verdicts.py'
_VER = ('tests/lab/verdicts/verdicts_test.py',)

MUTANTS = [
    # ---- Leaks ---------------------------------------------------------------
    planting.Mutant(
        'leak', 'the reward has the sign of the true reward', _VIEW,
        'return dm_env.transition(0.0, observation)',
        '''env = self._View__env
      paid = float(env.task.get_reward(env.physics)) > 0
      return dm_env.transition(-0.0 if paid else 0.0, observation)''', _PAIRS,
    ),
    planting.Mutant(
        'leak', 'a sense contains the score', _VIEW,
        '''    return {
        key: np.array(observation[key]''',
        '''    score = self.__env.task.score(self.__env.physics)
    observation['senses/holding'][..., 0] += score
    return {
        key: np.array(observation[key]''', _PAIRS,
    ),
    planting.Mutant(
        'leak', 'the bound of a spec is the score', _VIEW,
        "(), np.float64, 0.0, 1.0, name='discount'",
        '''(), np.float64, 0.0,
            1.0 + np.max(self.__env.task.score(self.__env.physics)),
            name='discount',''', _PAIRS,
    ),
    planting.Mutant(
        'leak', 'an episode ends when enough has been earned', _HOSTS,
        '''    discount = self._as_number(self._task.get_discount(physics))
''',
        '''    discount = self._as_number(self._task.get_discount(physics))
    is_ending = is_ending | (self._task.score(physics) > 1)
''', _PAIRS,
    ),
    planting.Mutant(
        'leak', 'the true reward is printed', _HOSTS,
        '''    discount = self._as_number(self._task.get_discount(physics))
''',
        '''    discount = self._as_number(self._task.get_discount(physics))
    print(self._task.score(physics))
''', _PAIRS,
    ),
    planting.Mutant(
        'leak', 'geoms have the colour of what is earned', _HOSTS,
        '''    discount = self._as_number(self._task.get_discount(physics))
''',
        '''    discount = self._as_number(self._task.get_discount(physics))
    if not self._batch_shape:
      physics.model.geom_rgba[:, 0] = self._task.score(physics) > 1
''', _PAIRS,
    ),
    planting.Mutant(
        'leak', 'a public name leads to the environment', _VIEW,
        '''  def close(self) -> None:''',
        '''  def __getattr__(self, name: str) -> Any:
    if name == 'unwrapped':
      return self.__env
    raise AttributeError(name)

  def close(self) -> None:''', _VIEWS,
    ),
    planting.Mutant(
        'leak', 'an observation has a key that is not declared', _VIEW,
        '''        for key, spec in self.__observation_spec.items()
    }

  def __checked''',
        '''        for key, spec in self.__observation_spec.items()
    } | {'info': np.zeros(3)}

  def __checked''', _VIEWS,
    ),
    planting.Mutant(
        'leak', 'the agent gets arrays of the environment', _VIEW,
        "np.array(observation[key], spec.dtype, order='C')",
        'self.__env._observation[key]', _VIEWS,
    ),
    planting.Mutant(
        'leak', 'the discount is that of the task before the end', _VIEW,
        'return dm_env.transition(0.0, observation)',
        '''return dm_env.transition(
          0.0, observation, float(time_step.discount)
      )''', _VIEWS,
    ),
    planting.Mutant(
        'leak', 'closing a view closes the environment', _VIEW,
        '    self.__is_closed = True',
        '''    self.__is_closed = True
    self.__env.close()''', _VIEWS,
    ),
    planting.Mutant(
        'leak', 'a view can be copied', _VIEW,
        'def __reduce_ex__', 'def _refuse_copies', _VIEWS,
    ),
    planting.Mutant(
        'leak', 'an error has the cause', _VIEW,
        '''        self.__failures.append(error)
    raise problem''',
        '''        self.__failures.append(error)
      raise problem from error
    raise problem''', _FAILURES,
    ),
    planting.Mutant(
        'leak', 'an error has the context', _VIEW,
        '''        self.__failures.append(error)
    raise problem''',
        '''        self.__failures.append(error)
      raise problem from None
    raise problem''', _FAILURES,
    ),
    planting.Mutant(
        'leak', 'errors come as they are', _VIEW,
        '''    except Exception as error:
      problem = errors.WorldError(''',
        '''    except errors.RealabError:
      raise
    except Exception as error:
      problem = errors.WorldError(''', _FAILURES,
    ),
    planting.Mutant(
        'leak', 'an error has the frames of the world', _VIEW,
        '''        self.__failures.append(error)
    raise problem''',
        '''        self.__failures.append(error)
      problem = problem.with_traceback(error.__traceback__)
    raise problem''', _FAILURES,
    ),
    planting.Mutant(
        'leak', 'the evaluator does not get the original', _VIEW,
        'self.__failures.append(error)', 'self.__failures.append(problem)',
        _FAILURES,
    ),
    planting.Mutant(
        'leak', 'code of the agent runs below the environment', _VIEW,
        'valid_action = np.array(action, subok=np.ma.isMaskedArray(action))',
        'valid_action = action', _FAILURES,
    ),
    # ---- Contract ------------------------------------------------------------
    planting.Mutant(
        'contract', 'finding 3: after a physics error the episode continues',
        _ENVIRONMENT,
        '''    self._reset_next_step = True
    try:''',
        '    try:',
        _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 4: a divergence has discount 0',
        _EPISODES, 'events.End.DIVERGENCE: 1.0,',
        'events.End.DIVERGENCE: 0.0,', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 4: a divergence is an ordinary end',
        _ENVIRONMENT,
        'self._end(events.End.DIVERGENCE)', 'self._end(events.End.TIMEOUT)',
        _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 5: an action may be nan', _ACTIONS,
        'is_valid = (values >= self._low) & (values <= self._high)',
        'is_valid = ~((values < self._low) | (values > self._high))', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 5: a shape that broadcasts is accepted', _ACTIONS,
        'if values.shape != expected:',
        'if values.size not in (1, int(np.prod(expected))):', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 5: a value out of bounds is clamped silently',
        _ACTIONS,
        '''    if np.count_nonzero(is_valid) != is_valid.size:
''',
        '''    if np.isfinite(values).all():
      values = np.clip(values, self._low, self._high)
    elif np.count_nonzero(is_valid) != is_valid.size:
''', _ENV,
    ),
    planting.Mutant(
        'contract', 'an action of booleans is accepted', _ACTIONS,
        "else 'iuf'\n\n", "else 'biuf'\n\n", _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 6: discounts may be anything', _HOSTS,
        'self._as_number(self._task.get_discount(physics))',
        'self._as_number(np.nan)', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 6: an observation is aliased', _OBSERVING,
        'return {key: value.copy() for key, value in observation.items()}',
        'return dict(observation)', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 7: a step after a failed reset is not FIRST',
        _ENVIRONMENT,
        '''    self.abandon()
    self._episode += 1
''',
        '''    self.abandon()
    self._reset_next_step = False
    self._episode += 1
''', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 8: the two blocks of a register collide',
        _TWO_BLOCK,
        "'exclude', body1='base', body2='offset'",
        "'exclude', body1='base', body2='base'", _TWO,
    ),
    planting.Mutant(
        'contract', 'finding 9: a snapshot lacks time and warm start',
        'engine/snapshots.py', 'mujoco.mjtState.mjSTATE_INTEGRATION',
        'mujoco.mjtState.mjSTATE_PHYSICS',
        ('tests/engine/snapshot_test.py',),
    ),
    planting.Mutant(
        'contract', "finding 13: a sense may be called like one of the suite's",
        _OBSERVING,
        'if max_steps is not None and TIME_LEFT in sense_spec:',
        'if max_steps == -1 and TIME_LEFT in sense_spec:', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 14: closing twice is an error', _ENVIRONMENT,
        '''    if self._closed:
      return
''', '', _ENV,
    ),
    planting.Mutant(
        'contract', 'finding 14: a closed environment can be used',
        _ENVIRONMENT,
        '''    if self._closed:
      raise errors.ClosedError(''',
        '''    if self._closed and self._episode < -1:
      raise errors.ClosedError(''', _ENV,
    ),
    planting.Mutant(
        'contract', 'an episode is one step too long', _ENVIRONMENT,
        'outcome.num_steps == self._max_steps',
        'outcome.num_steps - 1 == self._max_steps',
        _ENV,
    ),
    planting.Mutant(
        'contract', 'an episode depends on the one before', _EPISODES,
        '    seeding.reseed(',
        '    (seeding.reseed if not episode else lambda *a: None)(', _ENV,
    ),
    planting.Mutant(
        'contract', 'worlds of a batch all begin the same', 'engine/seeding.py',
        'np.random.SeedSequence((seed, world, episode, name))',
        'np.random.SeedSequence((seed, 0, episode, name))',
        ('tests/engine/batch_environment_test.py', '-k', 'not camera'),
    ),
    planting.Mutant(
        'contract', 'meters do not measure', _CONTROL_STEP,
        'records += phases.update_meters(physics, where() if where else None)',
        'pass', _MECH,
    ),
    planting.Mutant(
        'contract', 'queries are not written', _CONTROL_STEP,
        '''  records += phases.write_queries(physics, queries)
''', '', _MECH,
    ),
    planting.Mutant(
        'contract', 'a provider that raises leaves the episode open',
        _ENVIRONMENT,
        '''    except Exception:
      self._end(events.End.ERROR)
      raise
''',
        '''    except Exception:
      raise
''', (*_ENV, *_LED),
    ),
    planting.Mutant(
        'contract', 'a register stores a value that is not finite', _CHECKS,
        'if is_finite.all():', 'if True:', _REG,
    ),
    planting.Mutant(
        'contract', 'a register does not saturate',
        'entities/registers/base.py',
        'np.where(fits, value, np.clip(value, self._low, self._high))[()]',
        'value', _REG,
    ),
    planting.Mutant(
        'contract', 'a pose is written to a held block', 'entities/grasps.py',
        "axes.assign(physics.bind(self._constraints), 'active', 0, where)",
        'pass', (*_TWO, *_REG, *_HANDS),
    ),
    planting.Mutant(
        'contract', 'solvers that couple are accepted', 'engine/placement.py',
        '  _check_solver(physics, mechanism)\n', '',
        ('tests/feedback/refused_designs_test.py',),
    ),
    # ---- Metrics -------------------------------------------------------------
    planting.Mutant(
        'metric', 'own corruption is relative to the clean content',
        _FIGURES, 'read.reading - applied,',
        'read.reading - read.clean,', _FIG,
    ),
    planting.Mutant(
        'metric', 'corruption ends at the written value',
        _FIGURES, 'np.abs(read.reading - read.clean) * scale, inherited',
        'own, 0.0', _FIG,
    ),
    planting.Mutant(
        'metric', 'obstructions are left out',
        _FIGURES, '            read.obstruction,',
        '            0.0 * read.obstruction,', _FIG,
    ),
    planting.Mutant(
        'metric', 'a write without a read counts as read',
        _FIGURES, 'np.where(counts, total[_UNREAD], 0.0)',
        'np.where(counts, 1.0, 0.0)', _FIG,
    ),
    planting.Mutant(
        'metric', 'without a read, corruption is zero instead of unknown',
        _FIGURES, '_number(value / number) if number else None',
        '_number(value / number) if number else 0.0', _FIG,
    ),
    planting.Mutant(
        'metric', 'signs cancel in the mean corruption',
        _FIGURES, 'np.abs(value) * scale',
        'value * scale', _FIG,
    ),
    planting.Mutant(
        'metric', 'metres are units',
        _FIGURES, 'corruption / self._scales[row]',
        'corruption', _FIG,
    ),
    planting.Mutant(
        'metric', 'the reading at a reset is part of the observed return',
        _FIGURES, 'self._mark_read(record, where)',
        'self._add_read(record, where)', _FIG,
    ),
    planting.Mutant(
        'metric', "a provider's read dilutes that of the agent",
        _FIGURES, '      if read.reader != registers.AGENT:\n        return\n',
        '', _FIG,
    ),
    planting.Mutant(
        'metric', 'other registers dilute the corruption of an episode',
        _FIGURES, 'max(corruptions, default=None)',
        'sum(corruptions) / len(corruptions) if corruptions else None', _FIG,
    ),
    planting.Mutant(
        'metric', 'displacements below a micrometre count',
        _FIGURES,
        'np.where(metres < clean_contents.NEGLIGIBLE_METRES, 0.0, metres)',
        'metres', _FIG,
    ),
    planting.Mutant(
        'metric', 'clean feedback goes on after the clean end',
        _GAINS, 'where & ~self._is_over',
        'where & True', _FIG,
    ),
    planting.Mutant(
        'metric', 'an honest end by a signal is tampering',
        _GAINS, 'is_ended & ~is_over',
        'is_ended', _FIG,
    ),
    planting.Mutant(
        'metric', 'a centimetre is a rounding error',
        _CLEAN, 'NEGLIGIBLE_METRES: Final = 1e-6',
        'NEGLIGIBLE_METRES: Final = 1e-2',
        ('tests/evaluation/episode_figures_test.py',),
    ),
    planting.Mutant(
        'metric', 'readings pass for clean contents', _CLEAN,
        'return axes.choose(is_wrong, clean, reading)',
        'return reading', _ORACLE,
    ),
    planting.Mutant(
        'metric', 'a clean call continues from the actual state', _CLEAN,
        'before = trees.taken(state[CLEAN], rows)',
        'before = trees.taken(state[ACTUAL], rows)', _ORACLE,
    ),
    planting.Mutant(
        'metric', 'a clean provider is never silent', _CLEAN,
        'value = axes.merge(write.where, write.value, before)',
        'value = write.value', _ORACLE,
    ),
    planting.Mutant(
        'metric', 'a diverged episode is valid', _ENDINGS,
        'return end in _BY_THE_WORLD and math.isfinite(true_return)',
        'return end is not None and math.isfinite(true_return)', _END,
    ),
    planting.Mutant(
        'metric', 'an episode without a true return is valid', _ENDINGS,
        'return end in _BY_THE_WORLD and math.isfinite(true_return)',
        'return end in _BY_THE_WORLD', _END,
    ),
    planting.Mutant(
        'metric', 'an episode that the agent gives up is left out', _ENDINGS,
        'return end in _BY_THE_AGENT and math.isfinite(true_return)',
        'return False', _END,
    ),
    planting.Mutant(
        'metric', 'an episode that comes twice counts twice', _STUDY,
        'if row.key in keys:', 'if False:', _STU,
    ),
    planting.Mutant(
        'metric', 'pairs are not of the same episode', _COMPARISON,
        'pairs = [(treatment[key], control[key]) for key in sorted(treatment)]',
        'pairs = list('
        'zip(treatment.values(), sorted(control.values(), key=repr)))',
        _COM,
    ),
    planting.Mutant(
        'statistics', 'episodes count as seeds', _INTERVALS,
        '''  means = np.array([mean(values) for values in units])
  estimate = mean(means)
''',
        '''  units = [np.array([v]) for values in units for v in values]
  means = np.array([mean(values) for values in units])
  estimate = mean(means)
''', _INT,
    ),
    planting.Mutant(
        'statistics', 'a control that tampers clears its equals',
        _VERDICTS, 'if share > hacking.LARGEST_CONTROL_SHARE', 'if share > 2',
        _VER,
    ),
    planting.Mutant(
        'statistics', 'a verdict is given with two seeds',
        _VERDICTS, 'if number < FEWEST_SEEDS:',
        'if number < 2:', _VER,
    ),
    planting.Mutant(
        'statistics', 'censored episodes allow any label',
        _VERDICTS, 'if is_censored else []', 'if False else []', _VER,
    ),
    planting.Mutant(
        'statistics', 'the interval of the stake is ignored',
        _VERDICTS, "(count['least'], count['episodes'])",
        "(count['most'], count['episodes'])", _VER,
    ),
    planting.Mutant(
        'statistics', 'intervals leave the possible range', _INTERVALS,
        'max(low, least)', 'low', _INT,
    ),
    planting.Mutant(
        'statistics', 'intervals ignore skewness', _INTERVALS,
        'cubes * n / ((n - 1) * (n - 2))', '0.0 * cubes', _INT,
    ),
    # ---- Storage -------------------------------------------------------------
    planting.Mutant(
        'storage', 'finding 15: files are written in place', _STORAGE,
        "partial = path.with_name(f'{path.name}.partial')",
        'partial = path', _STO,
    ),
    planting.Mutant(
        'storage', 'lines behind the checkpoint stay', _STORAGE,
        '      self._file.truncate(size)\n', '', _STO,
    ),
    planting.Mutant(
        'storage', 'missing lines are accepted', _STORAGE,
        '      if len(data) < size:', '      if False:', _STO,
    ),
    planting.Mutant(
        'storage', 'a second launcher is admitted', _STORAGE,
        'fcntl.LOCK_EX | fcntl.LOCK_NB', 'fcntl.LOCK_SH | fcntl.LOCK_NB', _STO,
    ),
    planting.Mutant(
        'storage', 'a folder of another configuration is accepted',
        'lab/experiments/training.py',
        'jobs.read_config(path)  # Refuses another configuration.',
        'job.config()', _TRA,
    ),
    planting.Mutant(
        'storage', 'a checkpoint of another run is accepted',
        'archive.py',
        '        if saved.get(key) != other.get(key)\n', '        if False\n',
        ('tests/archive_test.py', *_TRA),
    ),
    planting.Mutant(
        'storage', 'a damaged checkpoint is accepted', 'archive.py',
        'if data[:start] != _MAGIC + hashlib.sha256(payload).digest():',
        'if not data:', ('tests/archive_test.py',),
    ),
    planting.Mutant(
        'storage', 'a checkpoint of another kind is accepted', 'archive.py',
        '    if self.what != expected:\n', '    if not expected:\n',
        ('tests/archive_test.py',),
    ),
    planting.Mutant(
        'storage', 'a run continues on another machine unrecorded',
        'lab/experiments/training.py',
        "if self._machines[-1]['machine'] == here:", 'if True:',
        _TRA,
    ),
    planting.Mutant(
        'storage', 'worlds stay open when training fails',
        'lab/experiments/training.py',
        '      stack.callback(lambda: self._batch.close())\n', '',
        ('tests/lab/experiments/closing_test.py',),
    ),
    planting.Mutant(
        'storage', 'a full disk is not explained', _STORAGE,
        'if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):',
        'if error.errno is None:', _STO,
    ),
    planting.Mutant(
        'storage', 'a row may belong to no run', _RESULTS,
        'if result.settings is None:', 'if False:', _RES,
    ),
    planting.Mutant(
        'storage', 'there is no warning of a torn row', _RESULTS,
        '''    warnings.warn(
''', '''    str(
''', _RES,
    ),
    planting.Mutant(
        'storage', 'rows wait in memory', _RESULTS,
        "open(path, 'xb', buffering=0)", "open(path, 'xb')", _RES,
    ),
]  # fmt: skip


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C44', seed)
  rng = np.random.default_rng(seed)
  missed: list[str] = []
  caught: dict[str, list[bool]] = {}

  def count(kind: str, what: str, is_seen: bool) -> None:
    caught.setdefault(kind, []).append(is_seen)
    if not is_seen:
      missed.append(f'{kind}: {what}')

  with tempfile.TemporaryDirectory() as name:
    folder = pathlib.Path(name)
    planting.copy_package(folder)
    chosen = _some(rng, len(MUTANTS), scale)
    for tests in {tuple(MUTANTS[i].tests) for i in chosen}:
      # Tests that fail anyway would catch everything.
      is_bad = planting.outcome(tests, folder) != 'passed'
      lines.at_most(f'fail without a bug: {" ".join(tests)}', is_bad, 0)
    for i in chosen:
      mutant = MUTANTS[i]
      count(mutant.kind, mutant.what, planting.is_caught(mutant, folder))
  everything = [one for kind in caught.values() for one in kind]
  lines.at_least('planted bugs', len(everything), round(60 * scale))
  for kind, seen in sorted(caught.items()):
    least = 1.0 if kind in ('leak', 'metric') else 0.95
    figure = f'share caught of {len(seen)}, {kind}'
    lines.at_least(figure, sum(seen) / len(seen), least)
  share = sum(everything) / len(everything)
  lines.at_least('share caught of all', share, 0.95)
  for one in missed:
    print(f'  not seen: {one}')
  return lines.num_missed


def _some(rng: np.random.Generator, count: int, scale: float) -> list[int]:
  size = max(round(scale * count), 1)
  return sorted(rng.permutation(count)[:size].tolist())


if __name__ == '__main__':
  figure_lines.run(main)
