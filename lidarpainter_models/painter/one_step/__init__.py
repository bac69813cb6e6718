"""The one-step diffusion painter of the paper at full size, on weights that the user brings."""
