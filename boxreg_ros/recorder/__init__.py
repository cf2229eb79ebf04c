"""Label files while driving: the process beside the live node, its segments and their recovery."""
