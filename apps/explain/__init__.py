"""What happened and why: where a run's time went, its slowest frames, and its trace for trace viewers.

This folder may import from apps/ and every lower folder, but not from apps/cli/.
"""

from __future__ import annotations
