"""How packets move between units: slots, shared memory and the message bus."""
