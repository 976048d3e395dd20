from .panda_gelsight import PandaGelSight as PandaGelSight
