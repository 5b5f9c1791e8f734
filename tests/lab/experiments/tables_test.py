"""Tests of the writer of tables."""

import pytest

from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import intervals

_RECORDS = [
    {'run': 'a|b', 'number': 3, 'text': '1.20', 'unknown': None},
    {'run': 'c', 'number': None, 'text': '2.50', 'share': 0.5, 'is_done': True},
]


def test_texts_and_whole_numbers_stay_as_they_are():
  table = tables.Table('Title', 'Note.', tables.frame(_RECORDS))
  title, _, note, _, header, _, first, second = table.markdown().splitlines()
  assert (title, note) == ('## Title', 'Note.')
  assert header.split() == (
      r'| run | number | text | unknown | share | is\_done |'.split()
  )
  assert first.split() == r'| a\|b | 3 | 1.20 | - | - | - |'.split()
  assert second.split() == '| c | - | 2.50 | - | 0.5 | True |'.split()


def test_unknown_figures_are_empty_in_csv_files_and_others_exact():
  interval = intervals.mean_interval({0: [1 / 3]})
  ends = tables.ends({'mean': interval, 'none': None})
  assert tables.csv_text([*_RECORDS, ends]).splitlines() == [
      'run,number,text,unknown,share,is_done,mean,mean_low,mean_high,none,'
      'none_low,none_high',
      'a|b,3,1.20,,,,,,,,,',
      'c,,2.50,,0.5,True,,,,,,',
      ',,,,,,0.3333333333333333,nan,nan,,,',
  ]


def test_ends_are_empty_where_seeds_are_printed():
  rate = intervals.mean_rate([0.12, 0.0, 0.03])
  assert tables.ends({'rate': rate}) == {
      'rate': pytest.approx(0.05), 'rate_low': None, 'rate_high': None
  }  # fmt: skip
  assert tables.by_seed({7: 0.12, 3: 0.0}) == '7: 0.12; 3: 0'


def test_a_table_without_rows_has_its_columns():
  table = tables.frame([], ['run', 'label'])
  header, _ = tables.markdown(table).splitlines()
  assert header.split() == '| run | label |'.split()
  first, _ = tables.frame(_RECORDS, ['text', 'run']).to_numpy().tolist()
  assert first == ['1.20', 'a|b']
