# The world of min.sc; read it after min.cam.sc.
# Words and rules are those of a reconstructed language, see workbench/scene/sc.py.
light -5 7 3  .85 .82 .75
material slab { color .35 .55 .5  kdr .95 ksr .05 e 8 }
material ball { color .9 .55 .15  kdr .75 ksr .45 e 60 }
use slab
polygon 6  2.4 0 0  1.2 0 -2.1  -1.2 0 -2.1  -2.4 0 0  -1.2 0 2.1  1.2 0 2.1
use ball
sphere .3 .9 -.2 .9
