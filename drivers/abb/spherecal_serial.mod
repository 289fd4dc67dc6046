MODULE SpherecalSerial
    ! The line over a serial port: 8 data bits, no parity, 1 stop bit, no handshake.
    CONST string SPH_COM:="COM1:";

    VAR iodev sphDevice;

    PROC SphOpen()
        SphClose;
        Open SPH_COM,sphDevice\Bin;
        ClearIOBuff sphDevice;
        sphLinkUp:=TRUE;
    ERROR
        sphLinkUp:=FALSE;
        WaitTime 0.5;
        RETURN;
    ENDPROC

    ! A serial line has one computer only.
    PROC SphNewcomer()
        RETURN;
    ENDPROC

    ! TRUE when sphChunk holds something new: one character at a time, so that no beginning of a line is
    ! lost when time runs out.
    FUNC bool SphReceive(num seconds)
        sphChunk:=ReadStrBin(sphDevice,1\Time:=seconds);
        RETURN TRUE;
    ERROR
        IF ERRNO=ERR_DEV_MAXTIME RETURN FALSE;
        sphLinkUp:=FALSE;
        RETURN FALSE;
    ENDFUNC

    PROC SphSend(string text)
        WriteStrBin sphDevice,text+"\0A";
    ERROR
        sphLinkUp:=FALSE;
        RETURN;
    ENDPROC

    PROC SphClose()
        Close sphDevice;
    ERROR
        TRYNEXT;
    ENDPROC
ENDMODULE
