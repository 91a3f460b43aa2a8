"""Small worlds of numbered cells: TrapGrid, the reward-gaming gridworlds, a learned reward."""
