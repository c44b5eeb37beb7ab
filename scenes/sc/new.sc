# Newton's cradle before a wall with stars: five balls on strings, one drawn aside.
# Words and rules are those of a reconstructed language, see workbench/scene/sc.py.
# The stars and the arrow on the base are concave polygons.
size 512 384
background .06 .07 .12
ambient .18 .18 .22
persp 38
lookat -2.6 2.5 5.2  -.15 1.15 -.1  0 1 0
world
light -4 6 5  .6 .56 .5
light 4 3 4  .35 .36 .45
light 0 5 -1  .22 .2 .16
material wall   { color .16 .22 .38  kdr 1  ksr 0  e 1 }
material star   { color .95 .85 .45  kdr .8  ksr 0  e 1  emission .1 .09 .03 }
material desk   { color .5 .3 .18  kdr .9  ksr .15  e 20 }
material base   { color .12 .12 .13  kdr .9  ksr .4  e 40 }
material brass  { color .85 .65 .3  kdr .7  ksr .5  e 35 }
material steel  { color .75 .77 .8  kdr .8  ksr .8  e 90 }
material string { color .9 .9 .85  kdr 1  ksr 0  e 1 }
push  # wall and desk
  use wall
  polygon 4  -9 -1 -2.5  9 -1 -2.5  9 7 -2.5  -9 7 -2.5
  use desk
  polygon 4  -9 -.1 5  9 -.1 5  9 -.1 -2.5  -9 -.1 -2.5
pop
push  # stars on the wall
  trans 0 0 -2.48
  use star
  polygon 10  -2.2 2.56 0  -2.2952 2.3311 0  -2.5424 2.3112 0  -2.3541 2.1499 0  -2.4116 1.9088 0  -2.2 2.038 0  -1.9884 1.9088 0  -2.0459 2.1499 0  -1.8576 2.3112 0  -2.1048 2.3311 0
  polygon 10  -0.53271 3.0011 0  -0.64193 2.8592 0  -0.81805 2.8916 0  -0.71684 2.7439 0  -0.80206 2.5864 0  -0.63028 2.637 0  -0.50682 2.5073 0  -0.50188 2.6863 0  -0.34036 2.7636 0  -0.50907 2.8236 0
  polygon 12  1.25 3 0  1.15 2.7732 0  0.90359 2.8 0  1.05 2.6 0  0.90359 2.4 0  1.15 2.4268 0  1.25 2.2 0  1.35 2.4268 0  1.5964 2.4 0  1.45 2.6 0  1.5964 2.8 0  1.35 2.7732 0
  polygon 10  2.2549 1.7561 0  2.2158 1.5813 0  2.0425 1.5362 0  2.1967 1.4451 0  2.186 1.2663 0  2.3203 1.3848 0  2.487 1.3194 0  2.4159 1.4837 0  2.5296 1.6221 0  2.3513 1.6052 0
  polygon 14  3.3 2.5 0  3.2284 2.3487 0  3.0655 2.387 0  3.1391 2.2367 0  3.0075 2.1332 0  3.171 2.0971 0  3.1698 1.9297 0  3.3 2.035 0  3.4302 1.9297 0  3.429 2.0971 0  3.5925 2.1332 0  3.4609 2.2367 0  3.5345 2.387 0  3.3716 2.3487 0
  polygon 10  0.3 1.8232 0  0.19059 1.7395 0  0.066174 1.7986 0  0.11197 1.6687 0  0.017291 1.5687 0  0.155 1.5721 0  0.22091 1.4511 0  0.26022 1.5831 0  0.39563 1.6084 0  0.28222 1.6866 0
  polygon 10  -1.1752 1.5067 0  -1.1821 1.3554 0  -1.3199 1.2923 0  -1.178 1.239 0  -1.1606 1.0885 0  -1.0661 1.207 0  -0.91761 1.177 0  -1.0011 1.3035 0  -0.92664 1.4354 0  -1.0727 1.3952 0
pop
push  # base
  use base
  push
  trans 0 0 0
  scale 1.8 0.1 1.1
  polygon 4  -1 -1 1   1 -1 1   1 1 1   -1 1 1
  polygon 4  1 -1 -1   -1 -1 -1   -1 1 -1   1 1 -1
  polygon 4  1 -1 1   1 -1 -1   1 1 -1   1 1 1
  polygon 4  -1 -1 -1   -1 -1 1   -1 1 1   -1 1 -1
  polygon 4  -1 1 1   1 1 1   1 1 -1   -1 1 -1
  polygon 4  -1 -1 -1   1 -1 -1   1 -1 1   -1 -1 1
  pop
  use brass
  polygon 7  -1.2 .102 1.0  .6 .102 1.0  .6 .102 1.05  1.1 .102 .95  .6 .102 .85  .6 .102 .9  -1.2 .102 .9
pop
push  # frame
  use brass
  push
  trans -1.35 1.1 -0.75
  scale 0.045 1 0.045
  polygon 4  -1 -1 1   1 -1 1   1 1 1   -1 1 1
  polygon 4  1 -1 -1   -1 -1 -1   -1 1 -1   1 1 -1
  polygon 4  1 -1 1   1 -1 -1   1 1 -1   1 1 1
  polygon 4  -1 -1 -1   -1 -1 1   -1 1 1   -1 1 -1
  polygon 4  -1 1 1   1 1 1   1 1 -1   -1 1 -1
  polygon 4  -1 -1 -1   1 -1 -1   1 -1 1   -1 -1 1
  pop
  push
  trans 1.35 1.1 -0.75
  scale 0.045 1 0.045
  polygon 4  -1 -1 1   1 -1 1   1 1 1   -1 1 1
  polygon 4  1 -1 -1   -1 -1 -1   -1 1 -1   1 1 -1
  polygon 4  1 -1 1   1 -1 -1   1 1 -1   1 1 1
  polygon 4  -1 -1 -1   -1 -1 1   -1 1 1   -1 1 -1
  polygon 4  -1 1 1   1 1 1   1 1 -1   -1 1 -1
  polygon 4  -1 -1 -1   1 -1 -1   1 -1 1   -1 -1 1
  pop
  push
  trans 0 2.1 -0.75
  scale 1.395 0.045 0.045
  polygon 4  -1 -1 1   1 -1 1   1 1 1   -1 1 1
  polygon 4  1 -1 -1   -1 -1 -1   -1 1 -1   1 1 -1
  polygon 4  1 -1 1   1 -1 -1   1 1 -1   1 1 1
  polygon 4  -1 -1 -1   -1 -1 1   -1 1 1   -1 1 -1
  polygon 4  -1 1 1   1 1 1   1 1 -1   -1 1 -1
  polygon 4  -1 -1 -1   1 -1 -1   1 -1 1   -1 -1 1
  pop
  push
  trans -1.35 1.1 0.75
  scale 0.045 1 0.045
  polygon 4  -1 -1 1   1 -1 1   1 1 1   -1 1 1
  polygon 4  1 -1 -1   -1 -1 -1   -1 1 -1   1 1 -1
  polygon 4  1 -1 1   1 -1 -1   1 1 -1   1 1 1
  polygon 4  -1 -1 -1   -1 -1 1   -1 1 1   -1 1 -1
  polygon 4  -1 1 1   1 1 1   1 1 -1   -1 1 -1
  polygon 4  -1 -1 -1   1 -1 -1   1 -1 1   -1 -1 1
  pop
  push
  trans 1.35 1.1 0.75
  scale 0.045 1 0.045
  polygon 4  -1 -1 1   1 -1 1   1 1 1   -1 1 1
  polygon 4  1 -1 -1   -1 -1 -1   -1 1 -1   1 1 -1
  polygon 4  1 -1 1   1 -1 -1   1 1 -1   1 1 1
  polygon 4  -1 -1 -1   -1 -1 1   -1 1 1   -1 1 -1
  polygon 4  -1 1 1   1 1 1   1 1 -1   -1 1 -1
  polygon 4  -1 -1 -1   1 -1 -1   1 -1 1   -1 -1 1
  pop
  push
  trans 0 2.1 0.75
  scale 1.395 0.045 0.045
  polygon 4  -1 -1 1   1 -1 1   1 1 1   -1 1 1
  polygon 4  1 -1 -1   -1 -1 -1   -1 1 -1   1 1 -1
  polygon 4  1 -1 1   1 -1 -1   1 1 -1   1 1 1
  polygon 4  -1 -1 -1   -1 -1 1   -1 1 1   -1 1 -1
  polygon 4  -1 1 1   1 1 1   1 1 -1   -1 1 -1
  polygon 4  -1 -1 -1   1 -1 -1   1 -1 1   -1 -1 1
  pop
pop
push  # balls
  push  # ball 1
    trans -0.84 2.1 0
    rot z -38
    use steel
    sphere 0 -1.2 0 .21
    use string
    polygon 4  -0.008 0 -0.75  0.008 0 -0.75  0.008 -1.2 0  -0.008 -1.2 0
    polygon 4  -0.008 0 0.75  0.008 0 0.75  0.008 -1.2 0  -0.008 -1.2 0
  pop
  push  # ball 2
    trans -0.42 2.1 0
    use steel
    sphere 0 -1.2 0 .21
    use string
    polygon 4  -0.008 0 -0.75  0.008 0 -0.75  0.008 -1.2 0  -0.008 -1.2 0
    polygon 4  -0.008 0 0.75  0.008 0 0.75  0.008 -1.2 0  -0.008 -1.2 0
  pop
  push  # ball 3
    trans 0 2.1 0
    use steel
    sphere 0 -1.2 0 .21
    use string
    polygon 4  -0.008 0 -0.75  0.008 0 -0.75  0.008 -1.2 0  -0.008 -1.2 0
    polygon 4  -0.008 0 0.75  0.008 0 0.75  0.008 -1.2 0  -0.008 -1.2 0
  pop
  push  # ball 4
    trans 0.42 2.1 0
    use steel
    sphere 0 -1.2 0 .21
    use string
    polygon 4  -0.008 0 -0.75  0.008 0 -0.75  0.008 -1.2 0  -0.008 -1.2 0
    polygon 4  -0.008 0 0.75  0.008 0 0.75  0.008 -1.2 0  -0.008 -1.2 0
  pop
  push  # ball 5
    trans 0.84 2.1 0
    use steel
    sphere 0 -1.2 0 .21
    use string
    polygon 4  -0.008 0 -0.75  0.008 0 -0.75  0.008 -1.2 0  -0.008 -1.2 0
    polygon 4  -0.008 0 0.75  0.008 0 0.75  0.008 -1.2 0  -0.008 -1.2 0
  pop
pop
