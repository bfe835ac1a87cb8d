"""``python -m hat_ros.cli``."""

import sys

from hat_ros.cli import main

sys.exit(main())
