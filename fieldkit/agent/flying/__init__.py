"""Parts of the programs that fly a drone and guard it: the origin and the fence, liveness, the guard."""
