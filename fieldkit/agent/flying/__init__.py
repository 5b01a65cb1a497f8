"""Parts of the programs that fly, guard and rescue a drone: origin and fence, liveness, loop, guard, rescue."""
