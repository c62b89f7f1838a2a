"""What is shown and what it needs: scene files, motion, camera, planner."""
