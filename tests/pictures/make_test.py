"""Tests of the pictures of the docs."""

import pathlib

from PIL import Image
import pytest

from pictures import carrying
from pictures import first_person
from pictures import tampering
from realab_suite import errors
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_learner
from tests.lab.experiments import fake_sweep
from tests.reports import pages

_IMAGES = pathlib.Path(__file__).parents[2] / 'docs' / 'images'
_SIZES = {
    'first_person.png': first_person.SIZE,
    'carrying.png': carrying.SIZE,
    'tampering.gif': tampering.SIZE,
}


def _sweep(folder, twin):
  """Writes a sweep of untrained agents, one episode each."""
  one = fake_sweep.experiment(
      runs={'reward': {'design': 'instantaneous_reward', 'twin': twin}},
      baselines=[], seeds=[3], max_steps=4, evaluation={'episodes': 1},
      training={'num_envs': 2, 'steps': 8, 'curve_every': 8},
  )  # fmt: skip
  folder.mkdir()
  planned = jobs.plan(one)
  scheduler._describe(one, planned, False, folder)
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(training, 'make_learner', fake_learner.make)
    for job in planned:
      training.run(job, folder, training.Options(pages.quiet))
  return folder


@pytest.mark.parametrize('name', _SIZES)
def test_the_pictures_of_the_docs_have_the_sizes_of_the_program(name):
  with Image.open(_IMAGES / name) as image:
    assert image.size == _SIZES[name]
  assert (_IMAGES / name).stat().st_size < 3_000_000


def test_a_sweep_without_the_secure_twin_is_refused(tmp_path, monkeypatch):
  monkeypatch.setattr(tampering, '_TITLES', {'reward.secure': 'left'})
  with pytest.raises(
      errors.ResultsError, match='no episode of the secure twin'
  ):
    tampering.draw(tmp_path / 'a.gif', _sweep(tmp_path / 'sweep', twin=False))
  assert not (tmp_path / 'a.gif').exists()


# In one test, because each that renders is run by a process of its own.
@pytest.mark.camera
def test_each_picture_is_made_and_shows_its_objects(tmp_path, monkeypatch):
  make_labels = first_person.labels
  made = []

  def labels(env, view):
    # The label of the offset block states this value.
    assert env.mechanism.registers['reward'].applied(env.physics) == 1.0
    made.extend(make_labels(env, view))
    return made

  monkeypatch.setattr(first_person, 'labels', labels)
  monkeypatch.setattr(tampering, 'STEPS', 6)
  first_person.draw(tmp_path / 'first_person.png')
  carrying.draw(tmp_path / 'carrying.png')
  sweep = _sweep(tmp_path / 'sweep', twin=True)
  tampering.draw(tmp_path / 'tampering.gif', sweep)
  for name, size in _SIZES.items():
    with Image.open(tmp_path / name) as image:
      assert image.size == size
      assert len(image.convert('RGB').getcolors(2**24)) > 100
  assert len(made) == 5
  for label in made:
    assert len(label.anchors)
    assert (label.anchors > 0).all()
    assert (label.anchors < first_person.SIZE).all()
