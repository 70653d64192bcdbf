"""The report: figures seen from above, and the page that shows a run to a reader who has not read the paper."""
