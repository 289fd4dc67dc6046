MODULE SpherecalTcp
    ! The line over a socket; needs 616-1 PC Interface (or 672-1 Socket Messaging).
    CONST string SPH_ADDRESS:="192.168.125.1";
    CONST num SPH_PORT:=5000;

    VAR socketdev sphServer;
    VAR socketdev sphClientA;
    VAR socketdev sphClientB;
    VAR bool sphIsB:=FALSE;

    ! Listen, if that is not done yet, and wait for a computer; SphServe calls again when nobody came.
    PROC SphOpen()
        IF SocketGetStatus(sphServer)=SOCKET_CLOSED THEN
            SocketCreate sphServer;
            SocketBind sphServer,SPH_ADDRESS,SPH_PORT;
            SocketListen sphServer;
        ENDIF
        sphIsB:=FALSE;
        SocketClose sphClientA;
        SocketAccept sphServer,sphClientA\Time:=30;
        sphLinkUp:=TRUE;
    ERROR
        sphLinkUp:=FALSE;
        IF ERRNO<>ERR_SOCK_TIMEOUT SphClose;
        WaitTime 0.2;
        RETURN;
    ENDPROC

    ! After a silence: another computer that waits at the door takes the place of one whose cable is cut.
    PROC SphNewcomer()
        IF sphIsB THEN
            SocketAccept sphServer,sphClientA\Time:=0.1;
            SocketClose sphClientB;
            sphIsB:=FALSE;
        ELSE
            SocketAccept sphServer,sphClientB\Time:=0.1;
            SocketClose sphClientA;
            sphIsB:=TRUE;
        ENDIF
        sphTokenNo:=0;
        sphCacheIn:="";
        sphRest:="";
    ERROR
        RETURN;
    ENDPROC

    ! TRUE when sphChunk holds something new.
    FUNC bool SphReceive(num seconds)
        IF sphIsB THEN
            SocketReceive sphClientB\Str:=sphChunk\Time:=seconds;
        ELSE
            SocketReceive sphClientA\Str:=sphChunk\Time:=seconds;
        ENDIF
        RETURN TRUE;
    ERROR
        IF ERRNO=ERR_SOCK_TIMEOUT RETURN FALSE;
        sphLinkUp:=FALSE;
        RETURN FALSE;
    ENDFUNC

    PROC SphSend(string text)
        IF sphIsB THEN
            SocketSend sphClientB\Str:=text+"\0A";
        ELSE
            SocketSend sphClientA\Str:=text+"\0A";
        ENDIF
    ERROR
        sphLinkUp:=FALSE;
        RETURN;
    ENDPROC

    PROC SphClose()
        SocketClose sphClientA;
        SocketClose sphClientB;
        SocketClose sphServer;
    ERROR
        TRYNEXT;
    ENDPROC
ENDMODULE
