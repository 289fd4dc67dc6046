MODULE SpherecalJob
    ! For a program of your own that owns the motion: it stands, calls SphTrigger, may move on when that
    ! returns, and asks SphResult later. The computer runs `spherecal serve-cell`. Needs 616-1.
    CONST string SPH_PC_ADDRESS:="192.168.125.2";
    CONST num SPH_PC_PORT:=5005;
    CONST num SPH_PC_WAIT:=2;

    VAR socketdev sphPc;
    VAR num sphPcNumber:=0;
    VAR string sphPcReply:="";
    VAR bool sphPcUp:=FALSE;

    ! Takes a picture from where the robot stands now. FALSE: not taken, see the event log.
    FUNC bool SphTrigger(num id)
        VAR jointtarget here;
        VAR string body;
        VAR string told;

        WaitRob\ZeroSpeed;
        here:=CJointT();
        body:="TRIG "+NumToStr(id,0)+" "+SphAngle3(here.robax.rax_1)+" "+SphAngle3(here.robax.rax_2);
        body:=body+" "+SphAngle3(here.robax.rax_3)+" "+SphAngle3(here.robax.rax_4);
        body:=body+" "+SphAngle3(here.robax.rax_5)+" "+SphAngle3(here.robax.rax_6);
        IF NOT SphAsk(body,"C") RETURN FALSE;
        told:="EXPOSING";
        WHILE told="EXPOSING" DO
            WaitTime 0.05;
            told:=SphTold(id);
        ENDWHILE
        RETURN (told<>"NG" AND told<>"LOST");
    ENDFUNC

    ! Waits for the verdict on a picture: TRUE for OK.
    FUNC bool SphResult(num id)
        VAR string told:="EXPOSED";

        WHILE told="EXPOSING" OR told="EXPOSED" DO
            WaitTime 0.1;
            told:=SphTold(id);
        ENDWHILE
        RETURN (told="OK");
    ENDFUNC

    ! EXPOSING, EXPOSED, OK, NG or LOST.
    FUNC string SphTold(num id)
        VAR num start;
        VAR num found;

        IF NOT SphAsk("RESULT "+NumToStr(id,0),"R") RETURN "LOST";
        ! 1234 R id WORD ...
        start:=StrFind(sphPcReply,8," ")+1;
        found:=StrFind(sphPcReply,start," *");
        RETURN StrPart(sphPcReply,start,found-start);
    ENDFUNC

    ! Asks and waits for the reply to this very request; asks the same again once when none comes.
    FUNC bool SphAsk(string body,string code)
        VAR string text;

        sphPcNumber:=(sphPcNumber MOD 9999)+1;
        text:=SphFour(sphPcNumber)+" "+body;
        text:=text+"*"+SphSum3(text);
        FOR i FROM 1 TO 3 DO
            IF NOT sphPcUp SphConnect;
            IF sphPcUp SphTell text;
            IF sphPcUp THEN
                IF SphHeard(code) RETURN TRUE;
            ENDIF
        ENDFOR
        ErrWrite\W,"spherecal does not answer","Is spherecal serve-cell running?"\RL2:=body;
        RETURN FALSE;
    ENDFUNC

    PROC SphConnect()
        SocketClose sphPc;
        SocketCreate sphPc;
        SocketConnect sphPc,SPH_PC_ADDRESS,SPH_PC_PORT\Time:=SPH_PC_WAIT;
        sphPcUp:=TRUE;
    ERROR
        sphPcUp:=FALSE;
        RETURN;
    ENDPROC

    PROC SphTell(string text)
        SocketSend sphPc\Str:=text+"\0A";
    ERROR
        sphPcUp:=FALSE;
        RETURN;
    ENDPROC

    ! Reads up to a line feed; TRUE when it is the reply with our number, this code and a right checksum.
    FUNC bool SphHeard(string code)
        VAR string part;
        VAR num n;

        sphPcReply:="";
        part:="";
        WHILE part<>"\0A" DO
            SocketReceive sphPc\Str:=part\ReadNoOfBytes:=1\Time:=SPH_PC_WAIT;
            IF part<>"\0A" sphPcReply:=sphPcReply+part;
            IF StrLen(sphPcReply)>79 RETURN FALSE;
        ENDWHILE
        n:=StrLen(sphPcReply);
        IF n<10 RETURN FALSE;
        IF StrPart(sphPcReply,n-1,2)<>SphSum3(StrPart(sphPcReply,1,n-3)) RETURN FALSE;
        IF StrPart(sphPcReply,1,4)<>SphFour(sphPcNumber) RETURN FALSE;
        RETURN (StrPart(sphPcReply,6,1)=code);
    ERROR
        sphPcUp:=FALSE;
        RETURN FALSE;
    ENDFUNC

    FUNC string SphFour(num number)
        IF number<10 RETURN "000"+NumToStr(number,0);
        IF number<100 RETURN "00"+NumToStr(number,0);
        IF number<1000 RETURN "0"+NumToStr(number,0);
        RETURN NumToStr(number,0);
    ENDFUNC

    FUNC string SphAngle3(num degrees)
        VAR string text;

        text:=NumToStr(degrees,5);
        IF StrLen(text)>9 text:=NumToStr(degrees,4);
        RETURN text;
    ENDFUNC

    FUNC string SphSum3(string body)
        VAR num sum:=0;

        FOR i FROM 1 TO StrLen(body) DO
            sum:=(31*sum+StrToByte(StrPart(body,i,1)\Char)) MOD 251;
        ENDFOR
        RETURN ByteToStr(sum\Hex);
    ENDFUNC
ENDMODULE
