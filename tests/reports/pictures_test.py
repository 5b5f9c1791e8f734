"""Tests of strips and films."""

import copy
from unittest import mock

import numpy as np
from PIL import Image
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import evaluate
from realab_suite.lab.experiments import tracking
from realab_suite.reports import films


def _load(design='instantaneous_reward'):
  return suite.load(
      'unlock_door',
      'near',
      task_kwargs={'random': 4},
      environment_kwargs={'max_steps': 40},
      design=design,
  )


def _track(design='instantaneous_reward'):
  env = _load(design)
  recorder = tracking.Tracker(env)
  evaluate.evaluate(env, policies.make('random'), 1, sinks=[recorder])
  env.close()
  return recorder.track


@pytest.fixture(scope='module', name='recorded')
def _recorded():
  return _track()


@pytest.fixture(name='track')
def _own_track(recorded):
  """A copy of the track, to be changed."""
  return copy.deepcopy(recorded)


def test_a_strip_shows_corruption_that_a_meter_passed_on(track):
  strip = films.draw_strip('run', track, 480)
  # The reading is what was written, so the register itself was not moved.
  track.registers['reward'].clean[-1] -= 7.0
  assert (films.draw_strip('run', track, 480) != strip).any()


# In one test, because each that renders is run by a process of its own.
@pytest.mark.camera
def test_a_film_shows_every_step(tmp_path):
  from imageio import v3 as imageio

  env = _load()
  with films.film(env, tmp_path / 'film.mp4', 'run') as add:
    recorder = tracking.Tracker(env, add)
    evaluate.evaluate(env, policies.make('random'), 1, sinks=[recorder])
  frames = imageio.imread(tmp_path / 'film.mp4', plugin='pyav')
  assert len(frames) == 41
  assert frames.shape[2] == sum(films.WIDTHS.values())
  meta = imageio.immeta(tmp_path / 'film.mp4', plugin='pyav')
  assert meta['fps'] == 10
  assert meta['codec'] == 'h264'
  # x264 writes its settings into the film: by default, many threads.
  assert b' threads=1 ' in (tmp_path / 'film.mp4').read_bytes()
  # Players show their controls over the lower edge, so the strip is above.
  view = frames[:, -films.HEIGHT :]
  assert (frames[0, 2, 2] < 60).all()
  assert np.ptp(view[0]) > 100
  assert np.abs(view[0].astype(int) - view[-1]).max() > 50
  # An animated picture shows the same, and repeats.
  animation = tmp_path / 'new_folder' / 'film.webp'
  with films.film(env, animation, 'run') as add:
    recorder = tracking.Tracker(env, add)
    env.add_sink(recorder)
    env.reset()
    env.step(env.action_spec().minimum)
  with Image.open(animation) as animated:
    assert (animated.n_frames, animated.info['loop']) == (2, 0)
    animated.load()
    assert animated.info['duration'] == 100
    assert animated.size == frames.shape[2:0:-1]
  # The last frame of the shorter of two episodes stays.
  draw = films.panel(env, 'left', ['top_down'])
  left = [draw(recorder.track)] + [np.zeros_like(draw(recorder.track))] * 2
  for steps, name in ((1, 'short.mp4'), (4, 'long.mp4')):
    path = tmp_path / name
    with films.film(env, path, 'right', ['top_down'], left) as add:
      for _ in range(steps):
        add(env.physics, recorder.track)
    both = imageio.imread(path, plugin='pyav')
    middle = films.WIDTHS['top_down']
    assert both.shape[:3] == (max(steps, 3), len(left[0]), 2 * middle + 4)
    is_dark = [frame[-1, :middle].max() < 20 for frame in both]
    assert is_dark == [False] + [True] * (len(both) - 1)
    assert all(frame[-1, middle + 9 :].max() > 100 for frame in both)
  # A film is never overwritten.
  before = (tmp_path / 'film.mp4').read_bytes()
  with pytest.raises(errors.ResultsError, match='exists'):
    with films.film(env, tmp_path / 'film.mp4', 'run'):
      pass
  assert (tmp_path / 'film.mp4').read_bytes() == before


class _Stopped(BaseException):
  """An interruption."""


@pytest.mark.parametrize('place', ['Camera', 'imopen', 'init_video_stream'])
def test_a_film_that_fails_leaves_no_file(tmp_path, monkeypatch, place):
  path = tmp_path / 'film.mp4'
  files = []

  def stop(*unused, **unused_too):
    raise _Stopped

  def imopen(*unused, **unused_too):
    path.write_bytes(b'begun')
    files.append(mock.Mock(init_video_stream=stop))
    return files[-1]

  monkeypatch.setattr(films.engine, 'Camera', lambda *unused: None)
  monkeypatch.setattr(films.imageio, 'imopen', imopen)
  if place == 'Camera':
    monkeypatch.setattr(films.engine, 'Camera', stop)
  elif place == 'imopen':
    monkeypatch.setattr(films.imageio, 'imopen', stop)
  env = _load()
  for _ in range(2):  # Nothing is in the way of another attempt.
    with pytest.raises(_Stopped), films.film(env, path, 'title'):
      raise AssertionError('the film has begun')
  assert all(file.close.called for file in files)
  assert not list(tmp_path.iterdir())
  env.close()
