"""Move Gaussians until they show what was recorded: losses, optimisers, growth, steps."""
