# A ball on a six-sided slab under one light: min.cam.sc and min.nocam.sc in one file.
# Words and rules are those of a reconstructed language, see workbench/scene/sc.py.
size 384 288
background .55 .65 .8
ambient .2 .2 .22
persp 36
lookat -4 2.6 5.2  .1 .75 -.2  0 1 0
world
light -5 7 3  .85 .82 .75
material slab { color .35 .55 .5  kdr .95 ksr .05 e 8 }
material ball { color .9 .55 .15  kdr .75 ksr .45 e 60 }
use slab
polygon 6  2.4 0 0  1.2 0 -2.1  -1.2 0 -2.1  -2.4 0 0  -1.2 0 2.1  1.2 0 2.1
use ball
sphere .3 .9 -.2 .9
