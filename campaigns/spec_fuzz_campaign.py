"""Campaign C20: whatever a design or an experiment says, it runs or is refused.

Run from the root of the repository, about nine minutes on two processors:

    python -m campaigns.spec_fuzz_campaign

Half of the cases are drawn from the grammar of designs and experiments, with
hostile values in some places; half are files that ship, with damaged bytes,
lines and words. Each is validated; the first designs that are valid are put
into worlds, and the first worlds that there are then step. All of it happens in
child processes that may not take long or get large, because an odd model may
end the process that compiles it. Prints `C20 figure target verdict seed`.
Arguments are the scale and the seed.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent import futures
import contextlib
import copy
import math
import multiprocessing
import pathlib
import re
import resource
import sys
import tempfile
from typing import Any, NamedTuple

import hypothesis
from hypothesis import strategies as st
import numpy as np
import yaml

from campaigns import figure_lines
from realab_suite import errors
from realab_suite import suite
from realab_suite.experiments import experiment_specs
from realab_suite.feedback import specs
from tests import memory
from tests import patience
from tests import work
from tests.engine import helpers

NUM_VALIDATED = 20_000
NUM_COMPILED = 2_000
NUM_STEPPED = 300
STEPS = 200
MAX_CALLS = 5_000_000
MAX_BYTES = 512 * 2**20
_NUM_WORKERS = 2
_CONFIGS = pathlib.Path(suite.__file__).parents[1] / 'configs'
_KINDS = {'design': 'designs', 'experiment': 'experiments'}
# What a message may be about: a key of a spec, or what YAML is made of.
_NAMES_A_KEY = re.compile(
    r'\b(schema|name|description|channel|dof|registers?|meters?|providers|'
    r'schedule|action_set|learner|task|max_steps|runs|baselines|seeds|'
    r'calibration_seeds|training|evaluation|unknown key|design)\b'
)
_IS_SYNTAX = re.compile(
    r'(:\d+: |: not (YAML|UTF-8)|: expected a mapping|: file is |: more than |'
    r'entries|values in all|: [^ ]+: )'
)


class Case(NamedTuple):
  """Something that is to be a design or an experiment.

  Attributes:
    kind: `design` or `experiment`.
    source: What a file holds, or a mapping.
    task: Of the world that the design is put into.
    seed: Of that world.
  """

  kind: str
  source: Any
  task: tuple[str, str]
  seed: int


class Outcome(NamedTuple):
  """What became of a case.

  Attributes:
    stage: How far it came: `validate`, `compile` or `step`.
    problem: '' if it ran or was refused as it should be.
    refusal: With which words it was refused, or ''.
    calls: How many calls that took.
    grown: How much more memory its process had at most, bytes.
  """

  stage: str
  problem: str
  refusal: str
  calls: int = 0
  grown: int = 0


# The grammar: everything is as it should be, and some of it is spoiled then.

_HOSTILE = st.one_of(
    st.sampled_from(
        [
            None, True, False, '', 0, -1, 1, -0.0, 1e-300, 1e300, -1e300,
            math.nan, math.inf, -math.inf, 2**53, 2**63, 10**400, [], {}, [[]],
            'yes', '1e3', '.nan', '/etc/passwd', '../../x', 'a\nb', '\0',
            '\u202e', 'x' * 300, '~', '*', '%s', '{}', 'reward', 'score',
        ]
    ),
    st.floats(),
    st.integers(),
    st.text(max_size=8),
    st.lists(st.floats() | st.none() | st.text(max_size=3), max_size=4),
    st.dictionaries(st.text(max_size=6), st.integers() | st.none(), max_size=3),
)  # fmt: skip
_HOSTILE_KEYS = st.sampled_from(
    ['metres', 'kinds', 'world', '', 'a/b', '__class__', 'schema ', 'Ä', '<<']
)


def _mapping(
    required: Mapping[str, st.SearchStrategy[Any]],
    optional: Mapping[str, st.SearchStrategy[Any]],
) -> st.SearchStrategy[Any]:
  return st.fixed_dictionaries(dict(required), optional=dict(optional))


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
  """Yields every container with each of its keys or indices."""
  keys = node if isinstance(node, dict) else range(len(node))
  for key in list(keys):
    yield node, key
    if isinstance(node[key], dict | list):
      yield from _places(node[key])


@st.composite
def _spoiled(draw: Any, whole: st.SearchStrategy[Any]) -> Any:
  """Draws something with a few hostile values, keys or omissions, or none."""
  data = copy.deepcopy(draw(whole))
  for _ in range(draw(st.sampled_from([0, 0, 0, 1, 1, 2]))):
    places = list(_places(data))
    node, key = places[draw(st.integers(0, len(places) - 1))]
    how = draw(st.integers(0, 5))
    if how == 0:
      del node[key]
    elif how == 1 and isinstance(node, dict):
      node[draw(_HOSTILE_KEYS)] = draw(_HOSTILE)
    else:
      node[key] = draw(_HOSTILE)
  return data


_NUMBER = st.one_of(
    st.integers(-3, 14), st.floats(-4, 4, allow_subnormal=False)
)
_PLACES = st.one_of(
    st.sampled_from(
        ['station_1', 'station_2', 'station_3', 'centre', 'east_wall', 'moon']
    ),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(list),
    _mapping(
        {'position': st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(list)},
        {
            'yaw': st.floats(-7, 7),
            'spread': st.tuples(st.floats(0, 1), st.floats(0, 1)).map(list),
        },
    ),
)
_RANGES = st.one_of(
    st.sampled_from([[-2, 12], [0, 13], [0, 20], [-1, 1], [0, 0.001]]),
    # A register begins at 0, unless its design says otherwise.
    st.tuples(st.floats(-5, 0), st.floats(0.1, 15)).map(list),
)
_ACTION_SETS = st.sampled_from(
    9 * [{'name': 'dmlab_like', 'version': 1}] + [{'name': 'x', 'version': 2}]
)
_NAMES = ['reward', 'score', 'query', 'other', 'hint']
_ROLES = {
    'reward': 'feedback', 'score': 'meter', 'query': 'query', 'other': 'query',
    'hint': 'signal',
}  # fmt: skip
_STATIONS = {
    'reward': 'station_1', 'score': 'station_2', 'query': 'station_2',
    'other': 'station_3', 'hint': 'station_3',
}  # fmt: skip


def _register(name: str) -> st.SearchStrategy[Any]:
  usually = st.integers(0, 7)
  return _mapping(
      {
          'kind': usually.flatmap(
              lambda draw: st.sampled_from(
                  ['block_position', 'block_orientation', 'tow_block']
              )
              if draw > 6
              else st.just('two_block')
          ),
          'role': st.just(_ROLES[name]),
          'place': usually.flatmap(
              lambda draw: _PLACES if draw > 5 else st.just(_STATIONS[name])
          ),
          'range': _RANGES,
      },
      {
          'scale': st.sampled_from([0.1, 0.05, 1e-6, 1, 10, 0.2]),
          'on_overflow': st.sampled_from(['saturate', 'error']),
          'channel': st.sampled_from(['embedded', 'welded', 'secure']),
          'dof': st.sampled_from(['free', 'planar']),
          'block_size': st.floats(0.06, 0.6),
          'mass': st.sampled_from([0.01, 0.5, 1, 30, 100]),
          'options': st.sampled_from([{}, {'colour': 1}, {'scale': 2}]),
      },
  )


_POLICIES = st.sampled_from(
    ['apple_seeker', 'no_op', 'random', 'carrying_saboteur', 'oracle',
     'network_demonstrator']
)  # fmt: skip
_OPTION = {
    'weights': st.sampled_from(
        ['demonstrator_v1', '/etc/passwd', '../x.npz', 'a\0b']
    ),
    'half_width': _NUMBER,
    'target': st.tuples(_NUMBER, _NUMBER).map(list),
    'direction': st.tuples(_NUMBER, _NUMBER).map(list),
}
_OPTIONS = _mapping(
    {}, {**_OPTION, 'policy': _POLICIES, 'options': _mapping({}, _OPTION)}
)
_PROVIDERS = st.one_of(
    st.fixed_dictionaries(
        {'kind': st.just('difference'), 'reads': st.just(['score']),
         'writes': st.just(['reward'])},
        optional={'initial': _NUMBER},
    ),
    st.fixed_dictionaries(
        {'kind': st.just('constant'),
         'writes': st.sampled_from([['reward'], ['hint'], ['reward', 'hint']])},
        optional={'value': _NUMBER},
    ),
    _mapping(
        {'kind': st.just('demonstration'), 'policy': _POLICIES,
         'writes': st.just(['reward'])},
        {'options': _OPTIONS},
    ),
    _mapping(
        {'kind': st.just('value_advice'), 'reads': st.just(['query']),
         'value_function': st.sampled_from(
             ['apple_seeker_approval', 'network_values']),
         'writes': st.just(['reward'])},
        {'query_delay': st.sampled_from([0, 1]), 'options': _OPTIONS},
    ),
    _mapping(
        {'kind': st.just('paired_advice'),
         'reads': st.just(['query', 'other']),
         'value_function': st.just('apple_seeker_approval'),
         'writes': st.just(['reward'])},
        {},
    ),
    _mapping({'kind': st.text(max_size=5)}, {'writes': _HOSTILE}),
)  # fmt: skip


@st.composite
def _designs(draw: Any) -> Any:
  """Draws a design whose parts mostly fit each other."""
  providers = draw(st.lists(_PROVIDERS, max_size=2))
  used = ['reward', *draw(st.lists(st.sampled_from(_NAMES), max_size=1))]
  for provider in providers:
    for key in ('reads', 'writes'):
      named = provider.get(key)
      if isinstance(named, list):
        used += [name for name in named if name in _ROLES]
  for name in ('score', 'query'):
    if name in used:  # They share a station.
      used = [n for n in used if n not in ('score', 'query')] + [name]
      break
  registers = {name: draw(_register(name)) for name in dict.fromkeys(used)}
  design = {
      'schema': 1,
      'name': 'fuzzed',
      'registers': registers,
      'providers': providers,
  }
  if 'score' in registers and draw(st.booleans()):
    measures = draw(st.just('score'))
    design['meters'] = [{'measures': measures, 'writes': 'score'}]
  speaks = any(
      p.get('kind') not in ('difference', 'constant') for p in providers
  )
  if speaks or draw(st.booleans()):
    design['action_set'] = draw(_ACTION_SETS)
  rest = draw(
      _mapping(
          {},
          {
              'channel': st.sampled_from(['embedded', 'welded', 'secure']),
              'dof': st.sampled_from(['free', 'planar']),
              'schedule': st.one_of(
                  st.just('cfmdp'),
                  st.fixed_dictionaries(
                      {
                          'meter_substep': st.integers(-1, 9),
                          'provider_substep': st.integers(0, 12),
                      }
                  ),
              ),
              'description': st.text(
                  st.characters(min_codepoint=32), max_size=5
              ),
              'learner': _mapping(
                  {'kind': st.just('policy_gradient')},
                  {'reward': st.sampled_from(['reward', 'score'])},
              ),
          },
      )
  )
  return {**design, **rest}


_RUNS = _mapping(
    {'design': st.sampled_from([*suite.DESIGNS, '/etc/hostname', 'x', '..'])},
    {
        'overrides': st.lists(
            st.sampled_from(
                [
                    'dof=planar',
                    'dof',
                    'registers.reward.scale=1',
                    'a.b.c=[',
                    '=',
                ]
            ),
            max_size=2,
        ),
        'learner': _mapping({}, {'kind': st.just('q_learning')}),
        'twin': st.booleans(),
        'steps': st.integers(-1, 10**11),
    },
)
_EXPERIMENTS = _mapping(
    {
        'schema': st.just(1),
        'name': st.just('fuzzed'),
        'task': st.sampled_from(['unlock_door.near', 'unlock_door.x', 'a.b']),
        'runs': st.dictionaries(
            st.sampled_from(['one', 'two', 'three', '../x']),
            _RUNS,
            min_size=1,
            max_size=2,
        ),
        'seeds': st.lists(
            st.integers(0, 99), min_size=1, max_size=3, unique=True
        ),
    },
    {
        'max_steps': st.integers(-1, 300),
        'baselines': st.lists(_POLICIES, max_size=2),
        'calibration_seeds': st.lists(st.integers(0, 9), max_size=2),
        'training': _mapping(
            {},
            {'num_envs': st.integers(0, 512), 'sleep': st.booleans()},
        ),
        'evaluation': _mapping({}, {'episodes': st.integers(0, 20)}),
    },
)


def drawn(number: int, seed: int) -> list[tuple[str, Any]]:
  """Draws kinds and sources from the grammar; some as text of a file."""
  found: list[tuple[str, Any]] = []

  @hypothesis.seed(seed)
  @hypothesis.settings(
      max_examples=number,
      database=None,
      deadline=None,
      derandomize=False,
      phases=[hypothesis.Phase.generate],
      suppress_health_check=list(hypothesis.HealthCheck),
  )
  @hypothesis.given(
      st.integers(0, 3).flatmap(
          lambda draw: _spoiled(_EXPERIMENTS).map(
              lambda data: ('experiment', data)
          )
          if draw == 0
          else _spoiled(_designs()).map(lambda data: ('design', data))
      )
  )
  def collect(one: tuple[str, Any]) -> None:
    found.append(one)

  # Hypothesis ends when it has seen all there is to a part of the choices.
  while len(found) < number:
    collect()
    collect = hypothesis.seed(seed + len(found))(collect)
  kept = found[:number]
  return [
      (kind, _as_text(data) if i % 2 else data)
      for i, (kind, data) in enumerate(kept)
  ]


class _Dumper(yaml.SafeDumper):
  """Writes the same list twice instead of an anchor and an alias."""

  def ignore_aliases(self, data: Any) -> bool:
    return True


def _as_text(data: Any) -> bytes:
  text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
  return text.encode('utf-8', 'surrogatepass')


# Damage to what ships.

_WORDS = re.compile(rb'[\w.]+')
_HOSTILE_WORDS = [
    b'.nan', b'-.inf', b'1e300', b'-1', b'0', b'yes', b'~', b'true', b'012',
    b'1' * 400, b'&a', b'*a', b'!!python/name:os.system', b'[', b'{}', b'""',
    b'../../etc/passwd', b'"\\0"', b'"\\u202e"', b'\xff', b'<<', b'? ', b'1:30',
]  # fmt: skip


def shipped(kind: str) -> list[bytes]:
  """Returns the files of a kind that ship."""
  folder = _CONFIGS / _KINDS[kind]
  return [path.read_bytes() for path in sorted(folder.glob('*.yaml'))]


def damaged(text: bytes, rng: np.random.Generator) -> bytes:
  """Returns a text with some damage."""
  for _ in range(int(rng.integers(1, 5))):
    text = _damage(text, rng)
  return text


def _damage(text: bytes, rng: np.random.Generator) -> bytes:
  where = int(rng.integers(len(text) + 1))
  how = int(rng.integers(8))
  if how == 0 and where < len(text):
    bit = 1 << int(rng.integers(8))
    return text[:where] + bytes([text[where] ^ bit]) + text[where + 1 :]
  if how == 1:
    return text[:where] + text[where + int(rng.integers(1, 20)) :]
  if how == 2:
    return text[:where] + rng.bytes(int(rng.integers(1, 4))) + text[where:]
  if how == 3:
    return text[:where]
  if how in (4, 5):
    rows = text.split(b'\n')
    one, other = (int(i) for i in rng.integers(len(rows), size=2))
    if how == 4:
      rows[one], rows[other] = rows[other], rows[one]
    else:
      rows.insert(one, rows[other])
    return b'\n'.join(rows)
  words = list(_WORDS.finditer(text))
  if not words:
    return text
  word = words[int(rng.integers(len(words)))]
  if how == 6:
    new = _HOSTILE_WORDS[int(rng.integers(len(_HOSTILE_WORDS)))]
  else:
    new = words[int(rng.integers(len(words)))].group()
  return text[: word.start()] + new + text[word.end() :]


def cases(number: int, seed: int) -> list[Case]:
  """Returns what is to be tried: half from the grammar, half damaged files."""
  rng = np.random.default_rng(seed)
  files = {kind: shipped(kind) for kind in _KINDS}
  sources = drawn(number // 2, seed)
  while len(sources) < number:
    kind = 'experiment' if rng.random() < 0.3 else 'design'
    texts = files[kind]
    one = texts[int(rng.integers(len(texts)))]
    sources.append((kind, damaged(one, rng)))
  order = rng.permutation(number)
  return [
      Case(
          *sources[i],
          suite.ALL_TASKS[int(rng.integers(len(suite.ALL_TASKS)))],
          int(rng.integers(2**31)),
      )
      for i in order
  ]


# What happens in a child.


def validate(case: Case, folder: pathlib.Path) -> Any:
  """Returns the spec that a case is."""
  source = case.source
  if isinstance(source, bytes):
    source = folder / 'given.yaml'
    source.write_bytes(case.source)
  if case.kind == 'experiment':
    return experiment_specs.load(source)
  return specs.load(source)


def complaint(error: errors.SpecError, case: Case, stage: str) -> str:
  """Returns what is wrong with the words of a refusal; '' if nothing is."""
  text = str(error)
  if not text.isprintable():
    return f'not one line of text: {text!r:.200}'
  if len(text) > 20_000:
    return f'too long: {text!r:.200}'
  if stage == 'validate' and isinstance(case.source, bytes):
    if 'given.yaml' not in text.split(': ')[0]:
      return f'names no file: {text!r:.200}'
  if not (_NAMES_A_KEY.search(text) or _IS_SYNTAX.search(text)):
    return f'names no place: {text!r:.200}'
  return ''


def run(env: Any, steps: int, seed: int) -> str:
  """Acts at random in a world; returns what is wrong with it."""
  time_step = env.reset()
  for action in helpers.random_actions(env, steps, seed):
    time_step = env.step(action)
    if time_step.last() and env.mechanism.step_count(env.physics) < 1:
      return 'an episode ended before its first step'
    for key, value in time_step.observation.items():
      if not np.isfinite(value).all():
        return f'{key} is not finite'
  return ''


def judge(case: Case, last_stage: str, folder: pathlib.Path) -> Outcome:
  """Takes a case as far as it is to go."""
  found = []
  before = memory.forget_peak()
  calls = work.num_calls(lambda: found.append(_judge(case, last_stage, folder)))
  return Outcome(*found[0], calls, memory.peak() - before)


def _judge(
    case: Case, last_stage: str, folder: pathlib.Path
) -> tuple[str, str, str]:
  """Returns the first three figures of an outcome."""
  stage = 'validate'
  problem = refusal = ''
  try:
    spec = validate(case, folder)
    if last_stage != 'validate' and case.kind == 'design':
      stage = 'compile'
      env = suite.load(
          *case.task, {'random': case.seed % 2**31}, {'max_steps': 50},
          design=spec,
      )  # fmt: skip
      with contextlib.closing(env):
        if last_stage == 'step':
          stage = 'step'
          problem = run(env, STEPS, case.seed)
  except errors.SpecError as error:
    refusal = str(error)
    problem = complaint(error, case, stage)
    if stage == 'step':
      problem = f'refused when it was running: {refusal}'
  except errors.RegisterValueError as error:
    # A design may ask for an error where a value is out of range.
    refusal = str(error)
    problem = '' if 'its range is' in refusal else refusal
  except BaseException as error:
    problem = f'{type(error).__name__}: {error!s:.200}'
  return stage, problem, refusal


def _serve(connection: Any) -> None:
  """Judges what comes in, until nothing does."""
  pages = pathlib.Path('/proc/self/statm').read_text(encoding='ascii').split()
  limit = int(pages[0]) * resource.getpagesize() + MAX_BYTES
  resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
  with tempfile.TemporaryDirectory() as folder:
    while (job := connection.recv()) is not None:
      connection.send(judge(*job, pathlib.Path(folder)))


class Child:
  """A process that judges cases, and is made anew when it has died."""

  def __init__(
      self, serve: Any = _serve, most_seconds: float = patience.SECONDS
  ) -> None:
    self._serve = serve
    self._patience = most_seconds
    self._process: Any = None

  def judge(self, case: Case, last_stage: str) -> Outcome:
    """Returns what became of a case, the death of the process included."""
    if self._process is None:
      self._start()
    try:
      self._connection.send((case, last_stage))
      if self._connection.poll(self._patience):
        outcome: Outcome = self._connection.recv()
        return outcome
      problem = f'no answer in {self._patience:g} s'
    except (EOFError, OSError):
      problem = 'the process died'
    self.close()
    return Outcome(last_stage, problem, '')

  def close(self) -> None:
    if self._process is None:
      return
    self._process.kill()
    self._process.join()
    self._connection.close()
    self._process = None

  def _start(self) -> None:
    context = multiprocessing.get_context('spawn')
    self._connection, theirs = context.Pipe()
    self._process = context.Process(target=self._serve, args=(theirs,))
    self._process.start()
    theirs.close()


def judge_all(
    given: Sequence[tuple[Case, str]], num_workers: int = _NUM_WORKERS
) -> list[Outcome]:
  """Judges cases, each up to a stage, in a few children."""
  outcomes: list[Any] = [None] * len(given)

  def work(first: int) -> None:
    with contextlib.closing(Child()) as child:
      for i in range(first, len(given), num_workers):
        outcomes[i] = child.judge(*given[i])

  with futures.ThreadPoolExecutor(num_workers) as pool:
    list(pool.map(work, range(num_workers)))
  return outcomes


def campaign(
    num_validated: int,
    num_compiled: int,
    num_stepped: int,
    seed: int,
    num_workers: int = _NUM_WORKERS,
) -> Iterator[tuple[Case, Outcome]]:
  """Yields cases with what became of them; late stages come last."""
  given = cases(num_validated, seed)
  validated = judge_all([(case, 'validate') for case in given], num_workers)
  yield from zip(given, validated, strict=True)
  valid = [
      case
      for case, outcome in zip(given, validated, strict=True)
      if case.kind == 'design' and not outcome.refusal and not outcome.problem
  ][:num_compiled]
  compiled = judge_all([(case, 'compile') for case in valid], num_workers)
  yield from zip(valid, compiled, strict=True)
  fitting = [
      case
      for case, outcome in zip(valid, compiled, strict=True)
      if not outcome.refusal and not outcome.problem
  ][:num_stepped]
  stepped = judge_all([(case, 'step') for case in fitting], num_workers)
  yield from zip(fitting, stepped, strict=True)


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C20', seed)
  sizes = [
      max(1, round(scale * n))
      for n in (NUM_VALIDATED, NUM_COMPILED, NUM_STEPPED)
  ]
  judged = list(campaign(*sizes, seed))
  for case, outcome in judged:
    if outcome.problem:
      print(outcome.stage, outcome.problem, f'{case!r:.2000}', file=sys.stderr)
  outcomes = [outcome for _, outcome in judged]
  # Each case is judged anew for each stage that it reaches.
  for what, stage, size in zip(
      ('validated', 'compiled', 'stepped'),
      ('validate', 'compile', 'step'),
      sizes,
      strict=True,
  ):
    of_stage = [outcome for outcome in outcomes if outcome.stage == stage]
    lines.at_least(what, len(of_stage), size)
    bad = sum(bool(outcome.problem) for outcome in of_stage)
    lines.at_most(f'bad outcomes of what was {what}', bad, 0)
    # Without these two, a loader that refuses all or nothing would do.
    refused = sum(bool(outcome.refusal) for outcome in of_stage)
    if stage != 'step':
      lines.at_least(f'refused of what was {what}', refused, 1)
    lines.at_least(f'accepted of what was {what}', len(of_stage) - refused, 1)
  calls = max(outcome.calls for outcome in outcomes)
  lines.at_most('most calls', calls, MAX_CALLS)
  grown = max(outcome.grown for outcome in outcomes)
  lines.at_most('largest growth, MiB', grown / 2**20, MAX_BYTES / 2**20)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
