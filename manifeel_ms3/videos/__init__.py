"""Videos of recorded and evaluated episodes: scene, policy camera, touch and contact force side by side."""
