MODULE SpherecalState
    ! The second program, for a semistatic task of its own (623-1 Multitasking): it tells motors and stops
    ! also while the first one is held. It moves nothing and takes no orders. Its four signals are system
    ! outputs, see INSTALL.html.
    CONST string SPH_ADDRESS2:="192.168.125.1";
    CONST num SPH_PORT2:=5001;
    CONST string SPH_TASK:="T_ROB1";

    PERS num sphEpoch:=0;
    VAR socketdev sphServer2;
    VAR socketdev sphClient2;
    VAR string sphChunk2:="";
    VAR string sphRest2:="";
    VAR bool sphUp2:=FALSE;

    PROC main()
        WHILE TRUE DO
            IF sphUp2 THEN
                IF SphReceive2() SphFeed2;
            ELSE
                SphOpen2;
            ENDIF
        ENDWHILE
    ENDPROC

    PROC SphOpen2()
        IF SocketGetStatus(sphServer2)=SOCKET_CLOSED THEN
            SocketCreate sphServer2;
            SocketBind sphServer2,SPH_ADDRESS2,SPH_PORT2;
            SocketListen sphServer2;
        ENDIF
        SocketClose sphClient2;
        sphRest2:="";
        SocketAccept sphServer2,sphClient2\Time:=30;
        sphUp2:=TRUE;
    ERROR
        sphUp2:=FALSE;
        IF ERRNO<>ERR_SOCK_TIMEOUT SocketClose sphServer2;
        WaitTime 0.2;
        RETURN;
    ENDPROC

    ! After ten seconds without a word the door is opened for another computer.
    FUNC bool SphReceive2()
        SocketReceive sphClient2\Str:=sphChunk2\Time:=10;
        RETURN TRUE;
    ERROR
        sphUp2:=FALSE;
        RETURN FALSE;
    ENDFUNC

    PROC SphFeed2()
        VAR num start:=1;
        VAR num found;

        WHILE start<=StrLen(sphChunk2) DO
            found:=StrFind(sphChunk2,start,"\0A");
            IF StrLen(sphRest2)+found-start>80 sphRest2:="";
            IF found>start sphRest2:=sphRest2+StrPart(sphChunk2,start,found-start);
            IF found<=StrLen(sphChunk2) THEN
                IF StrLen(sphRest2)>4 SphState2 StrPart(sphRest2,1,4);
                sphRest2:="";
            ENDIF
            start:=found+1;
        ENDWHILE
    ENDPROC

    ! Whatever was asked, the state is told.
    PROC SphState2(string number)
        VAR jointtarget here;
        VAR string text;

        here:=CJointT(\TaskName:=SPH_TASK);
        text:=number+" J "+NumToStr(sphEpoch,0)+" "+SphAngle2(here.robax.rax_1)+" "+SphAngle2(here.robax.rax_2);
        text:=text+" "+SphAngle2(here.robax.rax_3)+" "+SphAngle2(here.robax.rax_4);
        text:=text+" "+SphAngle2(here.robax.rax_5)+" "+SphAngle2(here.robax.rax_6);
        text:=text+" "+"R"+SphMode2()+SphMotors2()+SphStop2();
        text:=text+"*"+SphSum2(text);
        SocketSend sphClient2\Str:=text+"\0A";
    ERROR
        sphUp2:=FALSE;
        RETURN;
    ENDPROC

    FUNC string SphMode2()
        IF OpMode()=OP_AUTO RETURN "A";
        IF OpMode()=OP_MAN_PROG RETURN "R";
        IF OpMode()=OP_MAN_TEST RETURN "F";
        RETURN "U";
    ENDFUNC

    FUNC string SphMotors2()
        IF DOutput(sphMotorsOn)=1 RETURN "1";
        RETURN "0";
    ENDFUNC

    FUNC string SphStop2()
        IF DOutput(sphEmStop)=1 RETURN "E";
        IF DOutput(sphChainOk)=0 RETURN "G";
        IF DOutput(sphExecError)=1 RETURN "P";
        RETURN "N";
    ENDFUNC

    FUNC string SphAngle2(num degrees)
        VAR string text;

        text:=NumToStr(degrees,5);
        IF StrLen(text)>9 text:=NumToStr(degrees,4);
        RETURN text;
    ENDFUNC

    FUNC string SphSum2(string body)
        VAR num sum:=0;

        FOR i FROM 1 TO StrLen(body) DO
            sum:=(31*sum+StrToByte(StrPart(body,i,1)\Char)) MOD 251;
        ENDFOR
        RETURN ByteToStr(sum\Hex);
    ENDFUNC
ENDMODULE
