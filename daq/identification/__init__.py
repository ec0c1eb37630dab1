"""From logs to parameters: settings, records, the fit, its result; replays and comparisons."""
