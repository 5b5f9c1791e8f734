"""Tests of lines on the progress of many jobs."""

from realab_suite.experiments import progress


def test_a_line_on_many_jobs_is_made_every_half_minute():
  pace = progress.Pace(90_000, 15_000, 100.0)
  assert pace.line(10, 129.0) == ''
  first = pace.line(30_000, 130.0)
  assert first == '30,000 of 90,000 steps, 500 steps/s, 120 s left'
  assert pace.line(31_000, 159.9) == ''
  # The speed is that since the last line, or since the start of this run.
  second = pace.line(45_000, 160.0)
  assert second == '45,000 of 90,000 steps, 500 steps/s, 90 s left'
  assert pace.line(45_000, 190.0) == (
      '45,000 of 90,000 steps, 0 steps/s, waiting'
  )
  assert pace.line(90_000, 220.0) == '90,000 of 90,000 steps; evaluating'
