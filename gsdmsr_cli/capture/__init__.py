"""From a video, a rig or pictures to a scene folder with cameras; one module per stage."""
