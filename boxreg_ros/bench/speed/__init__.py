"""`boxreg bench speed`: time per window and tick, its scaling, its limits, and relabel."""
