"""Pictures of a scene by the renderer of its physics engine, with annotations by Pillow."""
