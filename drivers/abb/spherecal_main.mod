MODULE SpherecalMain
    ! The program's main where the computer moves the robot. A program of your own calls SphServe instead.
    PROC main()
        SphServe;
    ENDPROC
ENDMODULE
