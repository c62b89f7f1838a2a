"""What happened and why: where a run's time went, its slowest frames, and its trace for trace viewers.

It may use apps/ and every lower folder, but not apps/cli/.
"""

from __future__ import annotations
