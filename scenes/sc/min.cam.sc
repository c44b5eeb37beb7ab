# The camera of min.sc; read it before min.nocam.sc.
# Words and rules are those of a reconstructed language, see workbench/scene/sc.py.
size 384 288
background .55 .65 .8
ambient .2 .2 .22
persp 36
lookat -4 2.6 5.2  .1 .75 -.2  0 1 0
world
