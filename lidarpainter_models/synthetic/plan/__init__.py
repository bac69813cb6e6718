"""Where the street runs, what stands along it and how the car drives, before anything is drawn."""
