"""Reports: charts, figures and the page of a run."""
