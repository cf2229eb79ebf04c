"""What every test has around it: ROS that stays on this machine, by itself, and is strict."""

import os
from pathlib import Path
import signal
import sys
import tempfile

import torch

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
os.environ['ROS_LOG_DIR'] = str(Path(tempfile.gettempdir(), 'boxreg_ros_test_log'))
# Read when a message class is imported; without it misspelt fields and wrong types pass.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
# The wheels of ROS need it where ROS itself is not installed.
os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)

# A shell without job control starts what runs behind it with interrupts ignored, and all that that
# starts in turn: `boxreg` obeys, as it should, but the tests interrupt it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Small problems on few cores: threads cost more than they bring.
torch.set_num_threads(1)
