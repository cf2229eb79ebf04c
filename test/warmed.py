"""
Import it to load the kernels, or to compile them if nobody has before.

The processes that nodes are forked from, and those that run tests, import it: every node and every
worker of `relabel` then begins with the kernels loaded.

"""

import gc

from boxreg_ros.config import Config
from boxreg_ros.io.warm_up import warm_up, warm_up_followed, warm_up_follower, warm_up_labels
import torch

_threads = torch.get_num_threads()
torch.set_num_threads(1)  # a fork would not have the threads of torch
for _estimate in ('final', 'track'):
    warm_up(Config(estimate=_estimate))
warm_up_follower(Config(estimate='track'))
warm_up_followed(Config(estimate='final'))
warm_up_labels(Config())
torch.set_num_threads(_threads)
gc.collect()
gc.freeze()  # a fork does not look for garbage among these objects: 0.2 s
