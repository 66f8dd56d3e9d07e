"""Reports: a study's tables as a page, summaries and figures."""
