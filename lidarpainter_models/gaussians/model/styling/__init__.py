"""Weather and night that live in a scene: what is stored of them, and what follows from it."""
